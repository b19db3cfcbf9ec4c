"""Figures of an inspection: paths in space and measures over time. [P:Fig.4, P:Fig.5]"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from perch_core import so3
from perch_eval.inspection.measures import InspectionResult

FLOWN, REFERENCE, HEADING, WIRE, COLLISION = "#1f5fa8", "#555555", "#3a9a4b", "#b02a2a", "#e8402a"
CAMERA_AXIS_LENGTH = 0.35  # of the drawn camera axis [m]


def paths_figure(flight: InspectionResult) -> Figure:
    """Plot reference and flight in space, as the paper's Fig. 4: collisions of the reference in red, camera axis in green."""
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    p, r = flight.states[:, 0:3], flight.reference_states[:, 0:3]
    low, high = np.minimum(p.min(axis=0), r.min(axis=0)) - 0.5, np.maximum(p.max(axis=0), r.max(axis=0)) + 0.5
    for line in flight.lines:
        points = line.centre + np.linspace(-line.half_length, line.half_length, 200)[:, None] * line.direction
        points = points[np.all((points > low - 1.0) & (points < high + 1.0), axis=1)]
        axes.plot(*points.T, color=WIRE, lw=3 if line is flight.line else 1.5)
    axes.plot(*r.T, color=REFERENCE, ls="--", lw=1, label="reference")
    hit = np.where((flight.reference.clearance < 0)[:, None], r, np.nan)
    axes.plot(*hit.T, color=COLLISION, lw=4, label=f"collides ({flight.reference.collisions})")
    axes.plot(*p.T, color=FLOWN, lw=1.5, label=f"flown ({flight.collisions} collisions)")
    for k in np.linspace(0, len(p) - 1, 45).astype(int):
        ahead = p[k] + CAMERA_AXIS_LENGTH * so3.quat_to_matrix(flight.states[k, 3:7])[:, 0]
        axes.plot(*np.stack([p[k], ahead]).T, color=HEADING, lw=1)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_box_aspect(high - low)
    axes.view_init(elev=22, azim=-150)
    axes.legend(loc="upper left", fontsize=8)
    return figure


def metrics_figure(flight: InspectionResult) -> Figure:
    """Plot clearance, reprojection error, cheirality and segment visibility over time, as the paper's Fig. 5."""
    figure = Figure(figsize=(8, 7.5), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    ways = ((flight.reference_times, flight.reference, REFERENCE, "--", "reference"), (flight.times, flight.flown, FLOWN, "-", "flown"))
    for times, judged, colour, style, label in ways:
        measures = judged.visibility
        panels[0].plot(times, judged.clearance, color=colour, ls=style, label=label)
        panels[1].plot(times, measures.reprojection, color=colour, ls=style,
                       label=f"{label}, mean {judged.reprojection:.0f} px")
        panels[2].plot(times, measures.cheirality.astype(int), color=colour, ls=style)
        panels[3].plot(times, measures.segment.astype(int), color=colour, ls=style)
    panels[0].axhspan(-1.0, 0.0, color=COLLISION, alpha=0.2)
    panels[0].set(ylabel="scaled clearance", ylim=(-1.0, 3.0), title="inspection")
    panels[1].set(ylabel=f"|reprojection| [px],\nat most {measures.corner:.0f} (corner)", ylim=(0.0, None))
    for panel, name in ((panels[2], "cheirality"), (panels[3], "segment visibility")):
        panel.axhspan(-0.2, 0.5, color=COLLISION, alpha=0.2)
        panel.set(ylabel=name, yticks=[0, 1], yticklabels=["violated", "holds"], ylim=(-0.2, 1.2))
    panels[3].set(xlabel="time [s]")
    panels[0].legend(fontsize=8, loc="upper right")
    panels[1].legend(fontsize=8, loc="upper right")
    return figure
