"""HTML report of a campaign: success rate, causes of failure, maps, error distributions, links to kept flights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from perch_eval.campaign.causes import MEANING, SUCCESS
from perch_eval.campaign.results import RunResult, flight_folder, worst
from perch_eval.campaign.specification import Campaign, values_text
from perch_eval.metrics import FIGURES
from perch_eval.page import Html, image, page, section, table, text
from perch_eval.revision import code_version
from perch_eval.statistics import Rate, Spread
from perch_sim.scenario import Scenario

BINS = 6
SUCCESS_COLOR, FAILURE_COLOR = "#2b8a3e", "#c92a2a"
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
        parts.append(section(f"Success over {' and '.join(campaign.axes)}", image(success_map(complete, *campaign.axes))))
    if complete:
        parts.append(section("Success over each quantity, 95 % Wilson intervals",
                             "".join(image(success_curve(complete, name)) for name in varied)))
    present = {name: title for name, title in METRICS.items() if any(r.metrics.get(name) is not None for r in found)}
    if present:
        parts.append(section("Errors", _spreads(found, present) + image(histograms(found, present))))
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


def cells_of(values: Sequence[Any]) -> tuple[list[str], np.ndarray]:
    """Return the labels of a varied quantity's cells, and the index of each value's cell.

    The cells are its distinct values where there are few, bins of equal width otherwise.
    """
    keys = [str(list(v)) if isinstance(v, (list, tuple)) else v if isinstance(v, str) else float(v) for v in values]
    distinct = sorted(set(keys), key=lambda key: (isinstance(key, str), key))
    if len(distinct) <= 10 or isinstance(distinct[-1], str):
        return [key if isinstance(key, str) else f"{key:.4g}" for key in distinct], np.array([distinct.index(key) for key in keys])
    edges = np.linspace(float(distinct[0]), float(distinct[-1]), BINS + 1)
    return ([f"{low:.3g} - {high:.3g}" for low, high in zip(edges, edges[1:])],
            np.clip(np.searchsorted(edges, keys, side="right") - 1, 0, BINS - 1))


def success_map(found: Sequence[RunResult], x: str, y: str) -> Figure:
    """Plot the success rate over two varied quantities, with the counts in each cell."""
    (across, columns), (up, rows) = (cells_of([r.values[name] for r in found]) for name in (x, y))
    good, total = np.zeros((len(up), len(across))), np.zeros((len(up), len(across)))
    np.add.at(total, (rows, columns), 1)
    np.add.at(good, (rows, columns), [r.cause == SUCCESS for r in found])
    figure = Figure(figsize=(1.6 + 1.05 * len(across), 1.2 + 0.6 * len(up)), layout="constrained")
    axes = figure.subplots()
    share = np.where(total > 0, good / np.maximum(total, 1), np.nan)
    drawn = axes.imshow(share, origin="lower", vmin=0.0, vmax=1.0, cmap="RdYlGn", aspect="auto")
    for (row, column), n in np.ndenumerate(total):
        if n:
            axes.text(column, row, f"{100 * share[row, column]:.0f} %\n{good[row, column]:.0f}/{n:.0f}", ha="center",
                      va="center", fontsize=8)
    axes.set_xticks(range(len(across)), across, fontsize=8)
    axes.set_yticks(range(len(up)), up, fontsize=8)
    axes.set(xlabel=x, ylabel=y)
    figure.colorbar(drawn, label="success rate")
    return figure


def success_curve(found: Sequence[RunResult], name: str) -> Figure:
    """Plot the success rate over one varied quantity with 95 % Wilson intervals."""
    labels, cells = cells_of([r.values[name] for r in found])
    rates = [Rate.from_outcomes(r.cause == SUCCESS for r, cell in zip(found, cells) if cell == k) for k in range(len(labels))]
    figure = Figure(figsize=(max(4.0, 0.9 * len(labels) + 1.0), 2.6), layout="constrained")
    axes = figure.subplots()
    value = np.array([r.value for r in rates])
    low, high = np.array([r.interval for r in rates]).T
    axes.errorbar(range(len(labels)), value, [np.clip(value - low, 0, None), np.clip(high - value, 0, None)], fmt="o-",
                  color=SUCCESS_COLOR, capsize=4)
    axes.set_xticks(range(len(labels)), [f"{label}\nn={r.trials}" for label, r in zip(labels, rates)], fontsize=8)
    axes.set(ylim=(-0.03, 1.03), xlabel=name, ylabel="success rate")
    axes.grid(alpha=0.3)
    return figure


def histograms(found: Sequence[RunResult], names: dict[str, tuple[str, float]]) -> Figure:
    """Plot histograms of metrics, successes against failures.

    Args:
        found: results of the runs.
        names: metric -> (title with unit, factor).
    """
    columns = 3
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(11.0, 2.4 * rows), layout="constrained")
    for axes, (name, (title, factor)) in zip(figure.subplots(rows, columns, squeeze=False).flat, names.items()):
        groups = [[factor * value for r in found if (r.cause == SUCCESS) is good and (value := r.metrics.get(name)) is not None]
                  for good in (True, False)]
        everything = groups[0] + groups[1]
        axes.set_title(title, fontsize=9)
        axes.grid(alpha=0.3)
        if not everything:
            continue
        top = float(np.percentile(everything, 99)) or 1.0
        edges = np.linspace(min(0.0, min(everything)), max(top, 1e-9), 25)
        axes.hist([np.minimum(group, edges[-1]) for group in groups], bins=edges, stacked=True,
                  color=[SUCCESS_COLOR, FAILURE_COLOR], label=["perched", "failed"])
        axes.axvline(float(np.median(everything)), color="k", lw=0.8, ls="--", label="median")
        axes.yaxis.get_major_locator().set_params(integer=True)
        if max(everything) > edges[-1]:
            axes.set_title(f"{title}; last bar: and above", fontsize=9)
    figure.axes[0].legend(fontsize=8)
    for k in range(rows):
        figure.axes[columns * k].set_ylabel("flights")
    return figure
