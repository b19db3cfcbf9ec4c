"""The figures of a flight, or of several flights side by side, over the perch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from perch_core import so3
from perch_eval.flight import States
from perch_eval.flight_view import ESTIMATE, LIMIT, PAD, REFERENCE, TRUTH, FlightView
from perch_eval.metrics import contact_of, thrust_history, tilt_degrees

RUNNING = 1  # state in perch_msgs/EstimatorStatus
ARROW = 0.2  # length of a thrust direction [m]
BEFORE, AFTER = 0.3, 0.7  # shown around the perch [s]


class Line(NamedTuple):
    """A curve in a panel: times [s] and values, (n,) each."""

    t: np.ndarray
    y: np.ndarray
    colour: str
    label: str = ""
    style: str = "-"
    width: float = 1.3


Views = Sequence[FlightView]
Panel = tuple[str, list[Line]]
"""Label of the y axis with its unit, and curves."""


def panels(views: Views, content: Sequence[Panel], columns: int, height: float = 2.4, bounds: Sequence[float] = (),
           span: tuple[float, float] | None = None) -> Figure:
    """Plot panels over time. With several flights, the time of each is relative to the start of its perch.

    Args:
        views: flights; marked are the start of the perch and the contact, or, of several, the ends of the perches.
        content: panels, row by row.
        columns: number of panels side by side.
        height: of a panel [in].
        bounds: values of horizontal lines in each panel.
        span: displayed time span [s]; None: around the perch.
    """
    alone, rows = len(views) == 1, -(-len(content) // columns)
    low, high = span or (min(view.start - _time_offset(views, view) for view in views) - BEFORE,
                         max(min(view.end + AFTER, view.until) - _time_offset(views, view) for view in views))
    figure = Figure(figsize=(12, height * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for axis, (label, lines) in zip(grid.flat, content):
        for line in lines:
            keep = (line.t >= low) & (line.t <= high)
            axis.plot(line.t[keep], line.y[keep], line.style, color=line.colour, lw=line.width, label=line.label or None)
        for bound in bounds:
            axis.axhline(bound, color=LIMIT, lw=0.8, ls="--", label="bounds" if bound == bounds[0] else None)
        for time, colour, style, name in _marks(views):
            if low <= time <= high:
                axis.axvline(time, color=colour, lw=0.8, ls=style, label=name or None)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    if low < high:
        grid[0, 0].set_xlim(low, high)
    if grid[0, 0].get_legend_handles_labels()[1]:
        grid[0, 0].legend(fontsize=8)
    for axis in grid[-1]:
        axis.set_xlabel("time [s]" if alone else "time since the perch began [s]; dotted: its end")
    return figure


def _time_offset(views: Views, view: FlightView) -> float:
    """Return the time of a flight that is shown as 0 s [s]."""
    return 0.0 if len(views) == 1 else view.start


def _marks(views: Views) -> list[tuple[float, str, str, str]]:
    """Return time [s], colour, style and label of vertical lines: start of the perch, contact; of several flights, the ends."""
    if len(views) > 1:
        return [(view.end - view.start, view.colour, ":", "") for view in views]
    touch = contact_of(views[0].flight)
    return [(views[0].start, "0.7", "-", "perch begins"), *([(touch[0], "k", "-.", "contact")] if touch is not None else [])]


def _states(views: Views, pick: Callable[[States], np.ndarray], estimate: bool = True) -> list[Line]:
    """Return curves of reference, truth and estimate of one flight, or of the truth of several flights."""
    if len(views) > 1:
        return [Line(view.truth.t - view.start, pick(view.truth), view.colour, view.name) for view in views]
    view = views[0]
    kinds = [(view.reference, REFERENCE, "reference", "-"), (view.truth, TRUTH, "truth", "-"), (view.estimate, ESTIMATE, "estimate", "--")]
    return [Line(states.t, pick(states), colour, label, style) for states, colour, label, style in kinds[:3 if estimate else 2]
            if states is not None]


def tracking_figure(*views: FlightView) -> Figure:
    """Position and velocity over time (the paper's Fig. 5)."""
    def content(axis: int) -> list[Panel]:
        return [(f"{'xyz'[axis]} [m]", _states(views, lambda states: states.p[:, axis])),
                (f"v{'xyz'[axis]} [m/s]", _states(views, lambda states: states.v[:, axis]))]

    return panels(views, [panel for axis in range(3) for panel in content(axis)], 2)


def rates_figure(*views: FlightView) -> Figure:
    """Body rates (the paper's Fig. 6) and tilt."""
    def content(axis: int) -> Panel:
        return f"rate {'xyz'[axis]} [deg/s]", _states(views, lambda states: np.degrees(states.w[:, axis]), estimate=False)

    tilts = [Line(view.truth.t - _time_offset(views, view), tilt_degrees(view.truth.q), view.colour) for view in views]
    return panels(views, [*map(content, range(3)), ("tilt of b3 [deg]", tilts)], 2)


def thrust_figure(*views: FlightView) -> Figure:
    """Collective thrust against its bounds [M:eq16]."""
    reached: list[Line] = []
    commanded: list[Line] = []
    for view in views:
        t, *thrusts = thrust_history(view.flight, view.vehicle)
        for lines, thrust in zip((reached, commanded), thrusts):
            lines.append(Line(t - _time_offset(views, view), thrust, view.colour, view.name))
    bounds = sorted({4 * bound for view in views for bound in (view.vehicle.thrust_min, view.vehicle.thrust_max)})
    if len(views) > 1:
        return panels(views, [("reached [N]", reached), ("commanded [N]", commanded)], 2, bounds=bounds)
    t, reference = views[0].flight.vectors("controller/reference", lambda r: r.thrust)
    lines = [Line(t, reference, REFERENCE, "reference"),
             commanded[0]._replace(colour=ESTIMATE, label="commanded to the rotors (leads the lag)", width=0.9),
             reached[0]._replace(label="reached")]
    return panels(views, [("thrust [N]", lines)], 1, 2.8, bounds)


def error_figure(view: FlightView) -> Figure | None:
    """Plot the estimation error and the estimator's 3-sigma bounds over the whole flight; None if there is no estimate."""
    estimate = view.estimate
    if estimate is None:
        return None
    running = [t for t, health in view.flight.values("estimator/status") if health.state == RUNNING]
    began = running[0] if running else estimate.t[0]  # before, sigma is kilometres
    shown = [(t, state) for t, state in view.flight.values("odometry") if t >= began][::10]
    sigma = np.array([np.sqrt(np.maximum(0.0, state.pose_covariance.diagonal()[:3])) for _, state in shown])
    t, error = np.array([t for t, _ in shown]), estimate.p - view.truth.at(estimate.t).p
    return panels([view], [(f"error {name}, 3 sigma [cm]", [
        Line(estimate.t, 100 * error[:, i], TRUTH, "estimate - truth", width=1.0),
        *(Line(t, sign * 300 * sigma[:, i], LIMIT, label, "--", 0.7) for sign, label in ((-1, "3 sigma"), (1, "")))]) for i, name in enumerate("xyz")], 3, 2.8,
        span=(float(began), min(float(estimate.t[-1]), view.until)))


def distance_figure(*views: FlightView) -> Figure:
    """Distances of reference and estimate from the truth through the perch."""
    def lines(kind: str) -> list[Line]:
        found = []
        for view in views:
            states: States | None = getattr(view, kind)
            if states is not None:
                t = states.t[inside := (states.t >= view.start) & (states.t <= view.end)]
                distance = 100.0 * np.linalg.norm(states.p[inside] - view.truth.at(t).p, axis=1)
                found.append(Line(t - _time_offset(views, view), distance, view.colour, view.name))
        return found

    return panels(views, [(f"{kind} - truth [cm]", lines(kind)) for kind in ("reference", "estimate")], 2)


def path_figure(*views: FlightView) -> Figure:
    """Side view of the perch with the thrust direction as arrows (the paper's Fig. 5, right)."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    axis = figure.subplots()
    along = _horizontal(views[0])
    for ends, colour, label in _segments(views, "pad", _pad_from_side):
        axis.plot(ends[:, :2] @ along, ends[:, 2], color=colour, lw=5, solid_capstyle="butt", label=label)
    for view in views:
        reference_colour, name = (REFERENCE, "") if len(views) == 1 else (view.colour, f"{view.name}, ")
        for states, colour, width, label in ((view.reference, reference_colour, 1.0, f"{name}reference"),
                                             (view.truth, view.colour, 1.6, f"{name}truth")):
            if states is not None:
                keep = (states.t >= view.start - BEFORE) & (states.t <= view.end + 0.3)
                axis.plot(states.p[keep, :2] @ along, states.p[keep, 2], color=colour, lw=width, label=label)
        p, b3 = (v[::max(1, keep.sum() // 28)] for v in (
            view.truth.p[keep], ARROW * so3.quat_rotate(view.truth.q[keep], np.array([0.0, 0.0, 1.0]))))
        axis.quiver(p[:, :2] @ along, p[:, 2], b3[:, :2] @ along, b3[:, 2], width=0.004, angles="xy", scale_units="xy", scale=1.0,
                    color=ESTIMATE if len(views) == 1 else view.colour, label=f"{name}b3")
        axis.update_datalim(np.stack([(p + b3)[:, :2] @ along, (p + b3)[:, 2]], axis=1))
    axis.set_aspect("equal", adjustable="datalim")
    for ends, colour, label in _segments(views, "cable", lambda view: view.cables):  # drawn as far as the path is shown
        axis.add_artist(Line2D(ends[:, :2] @ along, ends[:, 2], color=colour, marker="o", ms=5, label=label))
    axis.set(xlabel="along the perch [m]", ylabel="z [m]")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure


def _pad_from_side(view: FlightView) -> np.ndarray:
    """End points of the pad's middle line in W [m], shape (1, 2, 3), or (0, 2, 3) where there is none."""
    if view.pad is None:
        return np.zeros((0, 2, 3))
    c, R = view.pad
    return np.array([[c - PAD * R[:, 0], c + PAD * R[:, 0]]])


def _segments(views: Views, kind: str, segments: Callable[[FlightView], np.ndarray]) -> list[tuple[np.ndarray, str, str]]:
    """Return end points (2, 3) [m], colour and label of the pads or cables; black if the same for all flights."""
    found = [segments(view) for view in views]
    if all(np.array_equal(found[0], other) for other in found):
        styles = [("k", kind)]
    else:
        styles = [(view.colour, f"{view.name}, {kind}") for view in views]
    return [(ends, colour, "" if k else label) for several, (colour, label) in zip(found, styles) for k, ends in enumerate(several)]


def _horizontal(view: FlightView) -> np.ndarray:
    """Return the horizontal unit vector towards the pad, or along the perch, shape (2,)."""
    begin, end = view.truth.at(np.array([view.start, view.end])).p
    for direction in (*([np.cross(view.pad[1][:, 1], [0.0, 0.0, 1.0])[:2]] if view.pad is not None else []), (end - begin)[:2]):
        if np.linalg.norm(direction) > 1e-6:
            return direction / np.linalg.norm(direction)
    return np.array([1.0, 0.0])
