"""`report.html` and `report.json` of a recording: results, errors, plots and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from perch_core.json_values import write_json
from perch_eval.page import image, images, page, section, table
from perch_eval.recordings.findings import Finding
from perch_eval.recordings.evaluation import Evaluation
from perch_eval.recordings.drawing import Shown
from perch_eval.recordings.perception import Frame, Perception
from perch_eval.recordings.recording import Recording
from perch_eval.recordings.trajectory import Trajectory

COLOURS = {"TRACKING": "#2ca02c", "RESTING": "#1f77b4", "LEAVING": "#17becf", "BLIND": "#d62728", "LOST": "#8c564b",
           "INITIALISING": "#bbbbbb"}


@dataclass
class Told:
    """Content of the report on a recording: figures for JSON, rows of text, plots and pictures by title."""

    figures: dict[str, Any]
    rows: list[tuple[str, str]]
    plots: dict[str, Figure] = field(default_factory=dict)
    pictures: dict[str, Sequence[Shown]] = field(default_factory=dict)

    def write(self, folder: Path, recording: Recording, findings: Sequence[Finding] = (), log: Mapping[tuple[str, str, str], int] = {}) -> None:
        """Write `report.json` and `report.html`, and print rows and findings; `log`: (node, level, text) -> count."""
        write_json(folder / "report.json", self.figures)
        lines = ((f"{node}: {level}", message, f"{n} times" if n > 1 else "") for (node, level, message), n in log.items())
        (folder / "report.html").write_text(page(
            recording.path.name, table(self.rows), *(section(name, image(figure, name)) for name, figure in self.plots.items()),
            *(section(name, images((f"{1e-9 * one.stamp:.3f} s: {one.caption}", one.pixels) for one in shown))
              for name, shown in self.pictures.items()),
            section("The sensors", table(((f.level, f.about, f.text) for f in findings), classes=[f.level for f in findings])),
            section("Log of the components", table(lines))))
        print("\n".join(f"{name}: {text}" for name, text in self.rows))
        for finding in findings:
            if finding.level != "ok":
                print(f"{finding.level}: {finding.about}: {finding.text}")
        print(f"report: {folder / 'report.html'}")


def path_figure(estimate: Trajectory, evaluation: Evaluation | None) -> Figure:
    """The path from above and from the side."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    for axes, (i, j) in zip(figure.subplots(1, 2), ((0, 1), (0, 2))):
        if evaluation is not None:
            axes.plot(evaluation.truth_W[:, i], evaluation.truth_W[:, j], color="0.3", lw=1.6, label="truth")
        axes.plot(estimate.p[:, i], estimate.p[:, j], color="C1", lw=1.2, label="VIO")
        axes.plot(*estimate.p[0, [i, j]], "o", color="C1", ms=5)
        axes.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")
        axes.axis("equal")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure


def frames_figure(frames: Sequence[Frame]) -> Figure:
    """Plot tracks over time; the background colour shows VIO's outcome of each frame."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    axes = figure.subplots()
    t = 1e-9 * np.array([f.stamp - frames[0].stamp for f in frames])
    for name in ("features", "used", "refused"):
        axes.plot(t, [getattr(f, name) for f in frames], lw=1.0, label=name)
    edges = [0, *(k for k in range(1, len(frames)) if frames[k].outcome != frames[k - 1].outcome), len(frames)]
    named: set[str] = set()
    for a, b in zip(edges[:-1], edges[1:]):
        outcome = frames[a].outcome
        axes.axvspan(t[a], t[min(b, len(t) - 1)], color=COLOURS.get(outcome, "#888888"),
                     alpha=0.15, lw=0, label=None if outcome in named else outcome.lower())
        named.add(outcome)
    axes.set(xlabel="time [s]", ylabel="tracks, observations")
    axes.legend(fontsize=8, ncol=4)
    axes.grid(alpha=0.3)
    return figure


def bias_figure(perception: Perception) -> Figure:
    """Plot the biases estimated by VIO, with 3 sigma."""
    states = perception.states
    t = 1e-9 * np.array([s.stamp - states[0].stamp for s in states])
    sigma = np.sqrt(np.array([np.diag(s.covariance) for s in states]))
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    for axes, name, first, unit in zip(figure.subplots(1, 2), ("gyro_bias", "accel_bias"), (9, 12), ("rad/s", "m/s^2")):
        values = np.array([getattr(s, name) for s in states])
        for i in range(3):
            axes.plot(t, values[:, i], color=f"C{i}", lw=1.2, label="xyz"[i])
            band = 3.0 * sigma[:, first + i]
            axes.fill_between(t, values[:, i] - band, values[:, i] + band, color=f"C{i}", alpha=0.12, lw=0)
        axes.set(ylabel=f"{name.replace('_', ' ')} [{unit}]", xlabel="time [s]")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure


def error_figure(evaluation: Evaluation, sigma: np.ndarray) -> Figure:
    """Plot the position error along each axis with 3 sigma, and the attitude error.

    Args:
        evaluation: of VIO's trajectory.
        sigma: 1 sigma of the position at its stamps [m], shape (n, 3).
    """
    t = 1e-9 * (evaluation.stamps - evaluation.stamps[0])
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).ravel()
    for i, axes in enumerate(panels[:3]):
        axes.fill_between(t, -300.0 * sigma[:, i], 300.0 * sigma[:, i], color="C1", alpha=0.2, lw=0, label="3 sigma")
        axes.plot(t, 100.0 * evaluation.error[:, i], color="C0", lw=1.2, label="error")
        axes.set_ylabel(f"{'xyz'[i]} [cm]")
        axes.legend(fontsize=8)
    panels[3].plot(t, np.degrees(np.linalg.norm(evaluation.turn, axis=1)), lw=1.2)
    panels[3].set_ylabel("attitude [deg]")
    for axes in panels:
        axes.grid(alpha=0.3)
    for axes in panels[2:]:
        axes.set_xlabel("time [s]")
    return figure
