"""HTML report of a campaign: success rate, causes of failure, maps, error distributions, links to kept flights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from perch_eval.campaign import figures
from perch_eval.campaign.causes import MEANING, SUCCESS
from perch_eval.campaign.results import RunResult, flight_folder, worst
from perch_eval.campaign.specification import Campaign, values_text
from perch_eval.metrics import FIGURES
from perch_eval.page import Html, image, page, section, table, text
from perch_eval.revision import code_version
from perch_eval.statistics import Rate, Spread
from perch_sim.scenario import Scenario

METRICS = {name: (f"{FIGURES[name][0]} [{FIGURES[name][1]}]", FIGURES[name][2]) for name in (
    "contact_normal_speed_m_s", "contact_tangential_speed_m_s", "contact_tilt_error_deg", "contact_offset_m", "target_error_position_m",
    "target_error_attitude_deg", "tracking_rmse_m_z", "estimation_rmse_m_z", "max_body_rate_deg_s")}
"""Metric -> title with unit, factor."""


def write_report(campaign: Campaign, found: Sequence[RunResult], folder: Path) -> Path:
    """Write `report.html` into the campaign's folder and return its path."""
    rate = Rate.from_outcomes(r.cause == SUCCESS for r in found)
    varied = [name for name in campaign.vary if name != "seed"]
    complete = [r for r in found if all(name in r.values for name in varied)]
    parts = [f"<p>{text(campaign.description)}</p>", _facts(campaign, found, rate), _causes(found, folder)]
    if campaign.axes and complete:
        parts.append(section(f"Success over {' and '.join(campaign.axes)}", image(figures.success_map(complete, *campaign.axes))))
    if complete:
        parts.append(section("Success over each quantity, 95 % Wilson intervals",
                             "".join(image(figures.success_curve(complete, name)) for name in varied)))
    present = {name: title for name, title in METRICS.items() if any(r.metrics.get(name) is not None for r in found)}
    if present:
        parts.append(section("Errors", _spreads(found, present) + image(figures.distributions(found, present))))
    parts.append(section("Failed flights, and kept ones", _flights(found, folder)))
    path = folder / "report.html"
    path.write_text(page(campaign.name, *parts, heading=text(campaign.name) + (f": {100 * rate.value:.1f} % success" if found else "")))
    return path


def _facts(campaign: Campaign, found: Sequence[RunResult], rate: Rate) -> str:
    wall, code = sum(r.wall_time for r in found), code_version()
    return table([
        ("scenario", campaign.base["name"]), *[("vehicle", campaign.base.get("vehicle", Scenario.vehicle))] * ("vehicle" not in campaign.vary),
        ("commit", code["commit"] + (f" (digest {code['digest']})" if code["digest"] else "")),
        ("successes", f"{rate} (95 % Wilson interval)"), ("flown", f"{len(found)} of {len(campaign.runs)} runs"),
        ("engine", campaign.engine + (f", cameras: vio {campaign.sensing.vio}, target {campaign.sensing.target}"
                                      if campaign.engine == "in_process" else "")),
        ("time of the workers", f"{wall:.0f} s, {wall / max(len(found), 1):.1f} s per flight"),
        ("varied", "; ".join(f"{name}: {d}" for name, d in campaign.vary.items()) or "the seed"),
        ("settings", f"SHA-256 {campaign.digest[:16]}")])


def _causes(found: Sequence[RunResult], folder: Path) -> str:
    failures = [r for r in found if r.cause != SUCCESS]
    most = Counter(r.cause for r in failures).most_common()
    rows = []
    for cause, count in most:
        examples = ", ".join(_link(r, folder) for r in worst([r for r in failures if r.cause == cause], 4))
        bar = Html(f'<div class="bar" style="width:{180 * count / most[0][1]:.0f}px"></div>')
        rows.append((count, bar, Html(f"<b>{text(cause)}</b>"), MEANING.get(cause, ""), Html(examples)))
    return section("Causes of failure, ranked", table(rows, ("flights", "", "cause", "", "worst runs")) if rows else "", "No flight failed.")


def _spreads(found: Sequence[RunResult], present: dict[str, tuple[str, float]]) -> str:
    perched = [r for r in found if r.cause == SUCCESS]
    rows = []
    for name, (title, factor) in present.items():
        spreads = [Spread.from_values(r.metrics.get(name) for r in some) for some in (found, perched)]
        rows.append((title, *(f"{spread.to_text(factor, 2)} ({spread.count})" for spread in spreads)))
    return table(rows, ("median [range] (number)", "all flights", "perched"))


def _flights(found: Sequence[RunResult], folder: Path) -> str:
    shown = [r for r in found if r.cause != SUCCESS][:200]
    kept = [r for r in found if r.cause == SUCCESS and (folder / flight_folder(r.number) / "report.html").exists()]
    return table(((Html(_link(r, folder)), r.seed, r.cause, r.message, values_text(r.values))
                  for r in (*shown, *kept)), ("run", "seed", "cause", "message", "conditions"))


def _link(result: RunResult, folder: Path) -> str:
    name, report = f"run {result.number}", flight_folder(result.number) / "report.html"
    return f'<a href="{report}">{name}</a>' if (folder / report).exists() else name
