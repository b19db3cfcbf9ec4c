"""A stroboscopic picture of a flight: the vehicle at instants of equal spacing, in front of the pad or the cables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from perch_core import so3
from perch_core.vehicle import Vehicle
from perch_eval.flight_view import LIMIT, PAD, SQUARE, FlightView
from perch_eval.metrics import tilt_degrees

AZIMUTH, ELEVATION = math.radians(-68.0), math.radians(12.0)  # of the observer, from the direction of flight
LABEL = 0.12           # between instants that both have one [m]
PLACES = (((0.0, -0.5 * PAD), "center", "top"), ((-0.8 * PAD, 0.0), "right", "center"), ((0.8 * PAD, 0.0), "left", "center"))
"""Of a label, in order of preference: offset from the body's centre in the picture [m], horizontal and vertical alignment."""
DISC = np.linspace(0.0, 2.0 * math.pi, 25)


def stroboscope(view: FlightView, start: float, end: float, instants: int = 10) -> Figure:
    """Draw the stroboscopic picture.

    Args:
        view: the flight.
        start, end: time span [s].
        instants: number of instants at which the vehicle is drawn.
    """
    times = np.linspace(start, end, instants)
    flown = view.truth.at(np.linspace(start, end, 200))
    observer = Observer(flown.p[-1] - flown.p[0])
    project = observer.project
    figure = Figure(figsize=(10.0, 5.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.axis("off")
    draw_place(axes, view, observer)
    axes.plot(*project(flown.p).T, color="0.6", lw=1.0, zorder=2)
    colors = colormaps["viridis"](np.linspace(0.0, 0.85, instants))
    states = view.truth.at(times)
    tilts = tilt_degrees(states.q)
    bodies = [draw_vehicle(axes, view.vehicle, p, so3.quat_to_matrix(q), observer, colors[k], 3 + k) for k, (p, q) in enumerate(zip(states.p, states.q))]
    left, low = project(flown.p).min(axis=0) - [0.1, 0.3]
    axes.plot([left, left + 0.5], [low, low], color="k", lw=2.0)
    axes.annotate("0.5 m", (left + 0.25, low - 0.02), ha="center", va="top", fontsize=8)
    axes.autoscale_view()
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the places of the labels are chosen in this layout
    taken = [(k, box_of(part)) for k, body in enumerate(bodies) for part in body]
    for k in reversed(range(instants)):  # the contact has the first choice
        if k == instants - 1 or np.linalg.norm(states.p[k + 1] - states.p[k]) > LABEL:
            text = f"{times[k] - end:+.2f} s, {tilts[k]:.0f}°"
            taken += [(-1, box) for box in draw_label(axes, text, project(states.p[k]), [box for n, box in taken if n != k])]
    return figure


def box_of(part: Any) -> Bbox:
    """Return the bounding box of a line or a disc in the figure's layout [px]."""
    transform = part.axes.transData
    return part.get_datalim(transform).transformed(transform) if isinstance(part, PolyCollection) else part.get_window_extent()


def draw_label(axes: Any, text: str, centre: np.ndarray, taken: Sequence[Bbox]) -> list[Bbox]:
    """Label a body where the label covers nothing else. Return the label's box; empty: there is no such place, and no label.

    Args:
        axes: of the picture.
        text: of the label.
        centre: of the body in the picture [m], shape (2,).
        taken: boxes that must not be covered [px].
    """
    for offset, horizontal, vertical in PLACES:
        label = axes.annotate(text, tuple(centre + offset), ha=horizontal, va=vertical, fontsize=7, color="0.25", zorder=50,
                              bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0.0, "pad": 0.5})
        box = label.get_window_extent()
        if (box.min > 0.0).all() and (box.max < axes.figure.bbox.max).all() and not box.count_overlaps(taken):
            return [box]
        label.remove()
    return []


class Observer:
    """Viewpoint at infinity (parallel projection) from which the flight goes to the right.

    Attributes:
        towards: direction from the flight to the observer, shape (3,).
    """

    def __init__(self, flight: np.ndarray) -> None:
        """
        Args:
            flight: vector from its start to its end [m], shape (3,).
        """
        a = math.atan2(flight[1], flight[0]) + AZIMUTH
        self.towards = np.array([math.cos(ELEVATION) * math.cos(a), math.cos(ELEVATION) * math.sin(a), math.sin(ELEVATION)])
        right = np.cross([0.0, 0.0, 1.0], self.towards)
        right /= np.linalg.norm(right)
        self._axes = np.column_stack([right, np.cross(self.towards, right)])

    def project(self, points: Any) -> np.ndarray:
        """Project points in W into the picture [m], shape (..., 3) -> (..., 2)."""
        return np.asarray(points) @ self._axes


def draw_place(axes: Any, view: FlightView, observer: Observer) -> None:
    """The pad with its tags, and the cables."""
    project = observer.project
    if view.pad is not None:
        p, R = view.pad
        surface = lambda centre, half: project(p + (np.asarray(centre) + half * SQUARE) @ R[:, :2].T)
        axes.add_collection(PolyCollection([surface((0.0, 0.0), 2.2 * PAD)], facecolor="0.93", edgecolor="0.8", zorder=0))
        axes.add_collection(PolyCollection([surface((0.0, 0.0), PAD)], facecolor="white", edgecolor="0.3", zorder=0.5))
        tags = [surface(0.55 * PAD * corner, 0.3 * PAD) for corner in SQUARE]
        axes.add_collection(PolyCollection(tags, facecolor="0.15", zorder=0.6))
    for a, b in view.cables:
        axes.plot(*project(np.array([a, b])).T, color="0.2", lw=2.5, solid_capstyle="round", zorder=1)


def draw_vehicle(axes: Any, vehicle: Vehicle, p: np.ndarray, R: np.ndarray, observer: Observer, color: Any, order: float) -> list[Any]:
    """Draw arms, rotor discs (farthest first) and thrust axis; front rotors are red. Return the drawn artists."""
    project = observer.project
    rotors = np.column_stack([vehicle.rotor_xy, np.zeros(len(vehicle.rotor_xy))])
    radius = 0.42 * float(np.min([np.linalg.norm(a - b) for i, a in enumerate(rotors) for b in rotors[:i]]))
    centres = p + (rotors + [0.0, 0.0, 0.02]) @ R.T
    drawn = []
    for arm in p + rotors @ R.T:
        drawn += axes.plot(*project(np.array([p, arm])).T, color=color, lw=2.4, solid_capstyle="round", zorder=order)
    ring = radius * (np.outer(np.cos(DISC), R[:, 0]) + np.outer(np.sin(DISC), R[:, 1]))
    for k in np.argsort(centres @ observer.towards):
        edge = LIMIT if rotors[k][0] > 0.0 else color
        drawn.append(axes.add_collection(PolyCollection(
            [project(centres[k] + ring)], facecolor=(*color[:3], 0.35), edgecolor=edge, lw=1.0, zorder=order + 0.1)))
    return drawn + axes.plot(*project(np.array([p, p + 0.12 * R[:, 2]])).T, color=LIMIT, lw=1.4, zorder=order + 0.2)
