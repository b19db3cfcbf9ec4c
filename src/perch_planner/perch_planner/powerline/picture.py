"""Pictures of a powerline manoeuvre: from the side with the body and its camera, the line metrics, an animation. [P:Fig.6-8]"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perch_core import so3
from perch_core.lines import Segment
from perch_core.rotor_model import P, Q
from perch_planner.powerline.plan import Manoeuvre
from perch_planner.powerline.problem import PlannedProblem
from perch_planner.powerline.visibility import visibility

PERCH, RECOVERY, CAMERA_AXIS, WIRE = "#1f5fa8", "#d9822b", "#3a9a4b", "#b02a2a"
CAMERA_AXIS_LENGTH = 0.5  # of the drawn camera axis [m]


class SideView:
    """Projection on the vertical plane perpendicular to the target line, for a vertical one on the plane from the start to it."""

    def __init__(self, line: Segment, start: np.ndarray) -> None:
        towards = (line.centre - start) * (1.0, 1.0, 0.0)
        horizontal = next(v for v in (np.cross(line.direction, [0.0, 0.0, 1.0]), towards, np.array([1.0, 0.0, 0.0])) if np.linalg.norm(v) > 1e-6)
        horizontal /= np.linalg.norm(horizontal)
        self.right_W = horizontal if horizontal @ (line.centre - start) > 0 else -horizontal
        self.origin = start

    def __call__(self, points_W: np.ndarray) -> np.ndarray:
        """Project points in W, shape (..., 3), to (distance towards the line, height), shape (..., 2)."""
        points_W = np.asarray(points_W, float)
        projected: np.ndarray = np.stack([(points_W - self.origin) @ self.right_W, points_W[..., 2]], axis=-1)
        return projected

    def body(self, state: np.ndarray, radii: tuple[float, float, float]) -> np.ndarray:
        """Outline of the body's ellipsoid, shape (60, 2): the projection of an ellipsoid is an ellipse."""
        A = np.stack([self.right_W, [0.0, 0.0, 1.0]]) @ so3.quat_to_matrix(state[Q]) @ np.diag(radii)
        U, s, _ = np.linalg.svd(A, full_matrices=False)
        angle = np.linspace(0, 2 * np.pi, 60)
        outline: np.ndarray = self(state[P]) + (U @ (s[:, None] * np.array([np.cos(angle), np.sin(angle)]))).T
        return outline


def _scene(planned: PlannedProblem, axes: Axes) -> SideView:
    view = SideView(planned.request.target(), planned.request.start[P])
    for line in planned.request.lines:
        ends = view(np.stack(line.ends))
        target = line.id == planned.request.target_line
        axes.plot(*ends.T, color=WIRE, lw=2 if target else 1, alpha=0.5)
        axes.plot(*view(line.centre), "o", color=WIRE, ms=7 if target else 4)
        axes.annotate(f"line {line.id}", tuple(view(line.centre)), xytext=(6, 6), textcoords="offset points", fontsize=8)
    axes.axhline(planned.problem.settings.height_min, color="0.5", ls=":", lw=1, label="least height")
    axes.set(xlabel="towards the line [m]", ylabel="height [m]", aspect="equal")
    return view


def _body(axes: Axes, view: SideView, planned: PlannedProblem, state: np.ndarray, colour: str) -> list[Any]:
    R_WB = so3.quat_to_matrix(state[Q])
    mount = planned.vehicle.mounts[planned.problem.settings.camera]
    p_WC = state[P] + R_WB @ mount.p_BC
    camera_axis = view(np.stack([p_WC, p_WC + CAMERA_AXIS_LENGTH * R_WB @ mount.R_BC[:, 2]]))
    thrust = view(np.stack([state[P], state[P] + 0.2 * R_WB[:, 2]]))
    return [*axes.plot(*view.body(state, planned.vehicle.body_radii).T, color=colour, lw=1.2),
            *axes.plot(*thrust.T, color=colour, lw=1.2), *axes.plot(*camera_axis.T, color=CAMERA_AXIS, lw=1)]


def draw_manoeuvre(planned: PlannedProblem, path: Path, bodies: int = 12) -> None:
    """Draw the manoeuvre from the side: bodies with their thrust direction (short) and camera axis (green)."""
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot()
    view = _scene(planned, axes)
    for name, part, colour in (("perch", planned.plan.perch, PERCH), ("recovery", planned.plan.recovery, RECOVERY)):
        if part is None:
            continue
        axes.plot(*view(part.states[:, P]).T, color=colour, lw=1, label=f"{name}, {part.duration:.2f} s")
        for k in np.linspace(0, len(part.times) - 1, bodies).astype(int):
            _body(axes, view, planned, part.states[k], colour)
    axes.plot([], [], color=CAMERA_AXIS, lw=1, label="camera axis")
    axes.set_title(planned.problem.description or planned.problem.name, fontsize=10)
    axes.legend(loc="lower left", fontsize=8)
    figure.savefig(path, dpi=130)


def draw_visibility(planned: PlannedProblem, path: Path, without: Manoeuvre | None = None) -> None:
    """Draw reprojection error and segment visibility of the target line over the perch, as the paper's Fig. 7.

    Args:
        planned: the plan.
        path: of the picture.
        without: the same perch planned without perception awareness, to compare with.
    """
    mount = planned.vehicle.mounts[planned.problem.settings.camera]
    figure = Figure(figsize=(8, 6), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    assert planned.plan.perch is not None
    perches = [(planned.plan.perch, PERCH, "with perception awareness" if planned.request.perception else "as planned")]
    if without is not None:
        perches.append((without, RECOVERY, "without"))
    for part, colour, label in perches:
        metrics = visibility(part.states, planned.request.target(), mount)
        top.plot(part.times, metrics.reprojection, color=colour, label=label)
        middle.plot(part.times, metrics.in_image, color=colour)
        bottom.plot(part.times, np.where(metrics.segment & metrics.cheirality, 1, 0), color=colour)
    top.set(ylabel=f"|reprojection| [px],\nat most {metrics.corner:.0f} (corner)", yscale="symlog", title=planned.problem.description or planned.problem.name)
    top.legend(fontsize=8)
    middle.set(ylabel="share in\nimage", ylim=(-0.05, 1.05))
    bottom.set(xlabel="time [s]", ylabel="constraints (12), (13)", yticks=[0, 1], yticklabels=["violated", "hold"], ylim=(-0.1, 1.1))
    figure.savefig(path, dpi=130)


def draw_animation(planned: PlannedProblem, path: Path, rate: float = 20.0) -> None:
    """Write an animation of the manoeuvre from the side, in real time, as a GIF."""
    figure = Figure(figsize=(7, 5), layout="constrained")
    axes = figure.add_subplot()
    view = _scene(planned, axes)
    trajectory = planned.plan.trajectory(planned.planner.solver.model, step=1 / rate)
    states = np.concatenate([trajectory.p, trajectory.q], axis=1)
    axes.plot(*view(trajectory.p).T, color="0.7", lw=1)
    perch_end = planned.plan.perch.duration if planned.plan.perch is not None else 0.0
    drawn: list[Any] = []

    def frame(k: int) -> list[Any]:
        while drawn:
            drawn.pop().remove()
        drawn.extend(_body(axes, view, planned, states[k], PERCH if trajectory.times[k] <= perch_end else RECOVERY))
        axes.set_title(f"{trajectory.times[k]:.2f} s", fontsize=10)
        return drawn

    FuncAnimation(figure, frame, frames=len(states)).save(path, writer=PillowWriter(fps=round(rate)))
