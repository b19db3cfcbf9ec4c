"""`report.html` and `report.json` of a recording: results, errors, plots and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from perch_core.json_values import write_json
from perch_core.values import InertialState
from perch_eval.page import figure_rows, image, images, page, section, table
from perch_eval.recordings.image_detections import GalleryImage
from perch_eval.recordings.imu_check import Report
from perch_eval.recordings.recording import Recording
from perch_eval.recordings.trajectory import Evaluation, Trajectory
from perch_perception.vio import VioResult

COLOURS = {"TRACKING": "#2ca02c", "RESTING": "#1f77b4", "LEAVING": "#17becf", "BLIND": "#d62728", "LOST": "#8c564b",
           "INITIALISING": "#bbbbbb"}


@dataclass
class ReportContent:
    """Content of the report on a recording: figures, plots and pictures by title."""

    figures: dict[str, Any]
    plots: dict[str, Figure] = field(default_factory=dict)
    pictures: dict[str, Sequence[GalleryImage]] = field(default_factory=dict)

    def write(self, folder: Path, recording: Recording, checked: Report = Report(), log: Mapping[tuple[str, str, str], int] = {}) -> None:
        """Write `report.json` and `report.html`, and print figures and findings; `log`: (node, level, text) -> count."""
        rows, findings = figure_rows(self.figures), checked.findings
        write_json(folder / "report.json", self.figures | {"findings": [f._asdict() for f in findings], "sensors": checked.figures})
        lines = ((f"{node}: {level}", message, f"{n} times" if n > 1 else "") for (node, level, message), n in log.items())
        (folder / "report.html").write_text(page(
            recording.path.name, table(rows), *(section(name, image(figure, name)) for name, figure in self.plots.items()),
            *(section(name, images(shown)) for name, shown in self.pictures.items()),
            section("The sensors", table(findings, classes=[f.level for f in findings])),
            section("Log of the components", table(lines))))
        print("\n".join(f"{name}: {text}" for name, text in rows))
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


def frames_figure(frames: Sequence[tuple[int, float, VioResult]]) -> Figure:
    """Plot tracks over time; the background colour shows VIO's outcome of each frame, as (stamp [ns], CPU time [s], result)."""
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    axes = figure.subplots()
    t, results = 1e-9 * np.array([stamp - frames[0][0] for stamp, _, _ in frames]), [result for _, _, result in frames]
    for name in ("features", "used", "refused"):
        axes.plot(t, [getattr(result, name) for result in results], lw=1.0, label=name)
    edges = [0, *(k for k in range(1, len(frames)) if results[k].outcome != results[k - 1].outcome), len(frames)]
    named: set[str] = set()
    for a, b in zip(edges[:-1], edges[1:]):
        outcome = results[a].outcome.name
        axes.axvspan(t[a], t[min(b, len(t) - 1)], color=COLOURS.get(outcome, "#888888"),
                     alpha=0.15, lw=0, label=None if outcome in named else outcome.lower())
        named.add(outcome)
    axes.set(xlabel="time [s]", ylabel="tracks, observations")
    axes.legend(fontsize=8, ncol=4)
    axes.grid(alpha=0.3)
    return figure


def bias_figure(states: Sequence[InertialState]) -> Figure:
    """Plot the biases estimated by VIO, with 3 sigma."""
    sigma = np.sqrt(np.array([np.diag(s.covariance) for s in states]))
    panels = {}
    for name, first, unit in (("gyro_bias", 9, "rad/s"), ("accel_bias", 12, "m/s^2")):
        values = np.array([getattr(s, name) for s in states])
        panels[f"{name.replace('_', ' ')} [{unit}]"] = [("xyz"[i], values[:, i], sigma[:, first + i]) for i in range(3)]
    return _over_time(np.array([s.stamp for s in states]), panels, 3.2)


def error_figure(evaluation: Evaluation, sigma: np.ndarray) -> Figure:
    """Plot the position error along each axis with 3 sigma, and the attitude error.

    Args:
        evaluation: of VIO's trajectory.
        sigma: 1 sigma of the position at its stamps [m], shape (n, 3).
    """
    panels = {f"{axis} [cm]": [("error", 100.0 * evaluation.error[:, i], None), ("3 sigma", 0.0 * sigma[:, i], 100.0 * sigma[:, i])]
              for i, axis in enumerate("xyz")}
    return _over_time(evaluation.stamps, panels | {"attitude [deg]": [("error", np.degrees(np.linalg.norm(evaluation.turn, axis=1)), None)]}, 5.5)


def _over_time(stamps: np.ndarray, panels: Mapping[str, Sequence[tuple[str, np.ndarray, np.ndarray | None]]], height: float) -> Figure:
    """Plot panels, two in a row, each by its title with (label, values, 1 sigma or None) over stamps [ns]; `height` of the figure [in]."""
    figure, t = Figure(figsize=(11, height), layout="constrained"), 1e-9 * (stamps - stamps[0])
    for axes, (title, curves) in zip(figure.subplots(len(panels) // 2, 2, sharex=True).flat, panels.items()):
        for k, (label, values, sigma) in enumerate(curves):
            axes.plot(t, values, color=f"C{k}", lw=1.2, label=label)
            if sigma is not None:
                axes.fill_between(t, values - 3.0 * sigma, values + 3.0 * sigma, color=f"C{k}", alpha=0.15, lw=0)
        axes.set(ylabel=title, xlabel="time [s]")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return figure
