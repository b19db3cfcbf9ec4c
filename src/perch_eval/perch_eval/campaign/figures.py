"""Figures of a campaign's report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.results import RunResult
from perch_eval.statistics import Rate

BINS = 6
GOOD, BAD = "#2b8a3e", "#c92a2a"


class Axis:
    """Cells of one varied quantity: its distinct values where there are few, bins of equal width otherwise."""

    def __init__(self, values: Sequence[Any]) -> None:
        distinct = sorted(set(map(_key, values)), key=lambda v: (isinstance(v, str), v))
        self._edges: np.ndarray | None = None
        if len(distinct) > 10 and not any(isinstance(v, str) for v in distinct):
            self._edges = np.linspace(float(distinct[0]), float(distinct[-1]), BINS + 1)
            self.labels = [f"{a:.3g} - {b:.3g}" for a, b in zip(self._edges, self._edges[1:])]
        else:
            self._values = distinct
            self.labels = [v if isinstance(v, str) else f"{v:.4g}" for v in distinct]

    def cell(self, value: Any) -> int:
        """Return the index of the cell that contains a value."""
        if self._edges is None:
            return self._values.index(_key(value))
        return min(max(int(np.searchsorted(self._edges, _key(value), side="right")) - 1, 0), BINS - 1)


def _key(value: Any) -> float | str:
    if isinstance(value, (list, tuple)):
        return str(list(value))
    return value if isinstance(value, str) else float(value)


def success_map(found: Sequence[RunResult], x: str, y: str) -> Figure:
    """Plot the success rate over two varied quantities, with the counts in each cell."""
    across, up = Axis([r.values[x] for r in found]), Axis([r.values[y] for r in found])
    good, total = np.zeros((len(up.labels), len(across.labels))), np.zeros((len(up.labels), len(across.labels)))
    for r in found:
        cell = up.cell(r.values[y]), across.cell(r.values[x])
        total[cell] += 1
        good[cell] += r.cause == SUCCESS
    figure = Figure(figsize=(1.6 + 1.05 * len(across.labels), 1.2 + 0.6 * len(up.labels)), layout="constrained")
    axes = figure.subplots()
    share = np.where(total > 0, good / np.maximum(total, 1), np.nan)
    image = axes.imshow(share, origin="lower", vmin=0.0, vmax=1.0, cmap="RdYlGn", aspect="auto")
    for (row, column), n in np.ndenumerate(total):
        if n:
            axes.text(column, row, f"{100 * share[row, column]:.0f} %\n{good[row, column]:.0f}/{n:.0f}", ha="center",
                      va="center", fontsize=8)
    axes.set_xticks(range(len(across.labels)), across.labels, fontsize=8)
    axes.set_yticks(range(len(up.labels)), up.labels, fontsize=8)
    axes.set(xlabel=x, ylabel=y)
    figure.colorbar(image, label="success rate")
    return figure


def success_curve(found: Sequence[RunResult], name: str) -> Figure:
    """Plot the success rate over one varied quantity with 95 % Wilson intervals."""
    axis = Axis([r.values[name] for r in found])
    cells = [[r for r in found if axis.cell(r.values[name]) == k] for k in range(len(axis.labels))]
    rates = [Rate.of(r.cause == SUCCESS for r in cell) for cell in cells]
    figure = Figure(figsize=(max(4.0, 0.9 * len(cells) + 1.0), 2.6), layout="constrained")
    axes = figure.subplots()
    value = np.array([r.value for r in rates])
    low, high = np.array([r.interval for r in rates]).T
    axes.errorbar(range(len(cells)), value, [np.clip(value - low, 0, None), np.clip(high - value, 0, None)], fmt="o-",
                  color=GOOD, capsize=4)
    axes.set_xticks(range(len(cells)), [f"{label}\nn={r.trials}" for label, r in zip(axis.labels, rates)], fontsize=8)
    axes.set(ylim=(-0.03, 1.03), xlabel=name, ylabel="success rate")
    axes.grid(alpha=0.3)
    return figure


def distributions(found: Sequence[RunResult], names: dict[str, tuple[str, float]]) -> Figure:
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
        axes.hist([np.minimum(group, edges[-1]) for group in groups], bins=edges, stacked=True, color=[GOOD, BAD],
                  label=["perched", "failed"])
        axes.axvline(float(np.median(everything)), color="k", lw=0.8, ls="--", label="median")
        axes.yaxis.get_major_locator().set_params(integer=True)
        if max(everything) > edges[-1]:
            axes.set_title(f"{title}; last bar: and above", fontsize=9)
    figure.axes[0].legend(fontsize=8)
    for k in range(rows):
        figure.axes[columns * k].set_ylabel("flights")
    return figure
