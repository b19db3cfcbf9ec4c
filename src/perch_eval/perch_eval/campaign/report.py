"""One HTML page for a campaign: success, causes, maps, error distributions, links to the kept flights."""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from perch_eval.campaign import figures
from perch_eval.campaign.causes import MEANING, SUCCESS
from perch_eval.campaign.ranking import worst
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Campaign
from perch_eval.statistics import Rate, Spread

METRICS = {
    "contact_normal_speed_m_s": ("normal speed at contact [m/s]", 1.0),
    "contact_tangential_speed_m_s": ("tangential speed at contact [m/s]", 1.0),
    "contact_tilt_error_deg": ("tilt error at contact [deg]", 1.0),
    "contact_offset_m": ("offset from the pad's centre [cm]", 100.0),
    "target_error_position_m": ("error of the localised target [cm]", 100.0),
    "target_error_attitude_deg": ("attitude error of the localised target [deg]", 1.0),
    "tracking_rmse_m_z": ("tracking RMSE, z [cm]", 100.0),
    "estimation_rmse_m_z": ("estimation RMSE, z [cm]", 100.0),
    "max_body_rate_deg_s": ("largest body rate [deg/s]", 1.0),
}
"""Metric -> title with unit, factor."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1150px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: 3px 14px 3px 0; text-align: left; vertical-align: top; }
td.n { text-align: right; font-variant-numeric: tabular-nums; } img { max-width: 100%; } .bar { background: #c92a2a; height: 11px; }
.curves { display: flex; flex-wrap: wrap; gap: 8px; } code { background: #f4f4f4; padding: 0 3px; }
"""


def write_report(campaign: Campaign, found: Sequence[RunResult], folder: Path) -> Path:
    """Write `report.html` into the campaign's folder and return its path."""
    path = folder / "report.html"
    path.write_text(_page(campaign, found, folder))
    return path


def _page(campaign: Campaign, found: Sequence[RunResult], folder: Path) -> str:
    rate = Rate(sum(r.cause == SUCCESS for r in found), len(found))
    parts = [f"<h1>{html.escape(campaign.name)}: {100 * rate.value:.1f} % success</h1>" if found else f"<h1>{campaign.name}</h1>",
             f"<p>{html.escape(campaign.description)}</p>", _facts(campaign, found, rate), _causes(found, folder)]
    complete = [r for r in found if all(name in r.values for name in campaign.vary if name != "seed")]
    if campaign.axes and complete:
        parts.append(f"<h2>Success over {' and '.join(map(html.escape, campaign.axes))}</h2>"
                     + _image(figures.success_map(complete, *campaign.axes)))
    varied = [name for name in campaign.vary if name != "seed"]
    if varied and complete:
        curves = "".join(_image(figures.success_curve(complete, name)) for name in varied)
        parts.append(f'<h2>Success over each quantity, 95 % Wilson intervals</h2><div class="curves">{curves}</div>')
    present = {name: title for name, title in METRICS.items() if any(r.metrics.get(name) is not None for r in found)}
    if present:
        parts += ["<h2>Errors</h2>", _spreads(found, present), _image(figures.distributions(found, present))]
    parts.append(_failures(found, folder))
    return (f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(campaign.name)}</title>'
            f"<style>{_STYLE}</style>{''.join(parts)}</html>\n")


def _facts(campaign: Campaign, found: Sequence[RunResult], rate: Rate) -> str:
    wall = sum(r.wall_time for r in found)
    rows = [("successes", f"{rate} (95 % Wilson interval)"), ("flown", f"{len(found)} of {len(campaign.runs)} runs"),
            ("engine", campaign.engine + (f", cameras: vio {campaign.sensing['vio']}, target {campaign.sensing['target']}"
                                          if campaign.engine == "in_process" else "")),
            ("time of the workers", f"{wall:.0f} s, {wall / max(len(found), 1):.1f} s per flight"),
            ("varied", "; ".join(f"{name}: {d.kind} {list(d.values)}" for name, d in campaign.vary.items()) or "the seed"),
            ("settings", f"SHA-256 {campaign.digest[:16]}")]
    return "<table>" + "".join(f"<tr><th>{k}</th><td>{html.escape(v)}</td></tr>" for k, v in rows) + "</table>"


def _causes(found: Sequence[RunResult], folder: Path) -> str:
    failures = [r for r in found if r.cause != SUCCESS]
    if not failures:
        return "<h2>Causes of failure</h2><p>No flight failed.</p>"
    most = Counter(r.cause for r in failures).most_common()
    rows = []
    for cause, count in most:
        examples = ", ".join(_link(r, folder) for r in worst([r for r in failures if r.cause == cause], 4))
        width = 180 * count / most[0][1]
        rows.append(f'<tr><td class="n">{count}</td><td><div class="bar" style="width:{width:.0f}px"></div></td>'
                    f"<th>{cause}</th><td>{html.escape(MEANING.get(cause, ''))}</td><td>{examples}</td></tr>")
    return (f"<h2>Causes of failure, ranked</h2><table><tr><th>flights</th><th></th><th>cause</th><th></th>"
            f"<th>worst runs</th></tr>{''.join(rows)}</table>")


def _spreads(found: Sequence[RunResult], present: dict[str, tuple[str, float]]) -> str:
    rows = "".join(f"<tr><th>{html.escape(title)}</th><td>{Spread.of(r.metrics.get(name) for r in found).words(factor, 2)}</td>"
                   f"<td>{Spread.of(r.metrics.get(name) for r in found if r.cause == SUCCESS).words(factor, 2)}</td></tr>"
                   for name, (title, factor) in present.items())
    return f"<table><tr><th>median [range]</th><th>all flights</th><th>perched</th></tr>{rows}</table>"


def _failures(found: Sequence[RunResult], folder: Path) -> str:
    shown = [r for r in found if r.cause != SUCCESS][:200]
    kept = [r for r in found if r.cause == SUCCESS and (folder / _report(r)).exists()]
    rows = "".join(
        f"<tr><td>{_link(r, folder)}</td><td>{r.seed}</td><td>{r.cause}</td><td>{html.escape(r.message)}</td>"
        f"<td>{html.escape(', '.join(f'{k} {_short(v)}' for k, v in r.values.items()))}</td></tr>" for r in (*shown, *kept))
    if not rows:
        return ""
    return ("<h2>Failed flights, and kept ones</h2><table><tr><th>run</th><th>seed</th><th>cause</th><th>message</th>"
            f"<th>conditions</th></tr>{rows}</table>")


def _report(result: RunResult) -> str:
    return f"flights/run_{result.number:05d}/report.html"


def _link(result: RunResult, folder: Path) -> str:
    name = f"run {result.number}"
    return f'<a href="{_report(result)}">{name}</a>' if (folder / _report(result)).exists() else name


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _image(data: str) -> str:
    return f'<img src="data:image/png;base64,{data}">'
