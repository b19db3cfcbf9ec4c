"""Where to start a perch: random starts for statistics, and the search for the best one (P's future work). [P:VII]"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perch_core import so3
from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment
from perch_core.rotor_model import P, V, RotorModel, hover_state
from perch_core.vehicle import Vehicle
from perch_planner.powerline.plan import PowerlinePlan
from perch_planner.powerline.problem import PowerlineProblem
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.visibility import visibility

SPREAD = np.array([0.7, 0.7, 0.4])  # half widths of the box of random starts [m]
SPREAD_YAW = np.radians(25.0)
SPREAD_SPEED = 0.2  # per axis [m/s]


def random_start(nominal: PowerlineRequest, problem: PowerlineProblem, vehicle: Vehicle, rng: np.random.Generator
                 ) -> PowerlineRequest:
    """The same perch from a start drawn around the nominal one, slowly drifting.

    Args:
        nominal: the problem's own request.
        problem: where the perch is given as point and pitch, its side follows the start.
        vehicle: mass and rotors of the start's hover.
        rng: source of the draw.
    """
    p_WB = nominal.start[P] + rng.uniform(-1, 1, 3) * SPREAD
    yaw = so3.quat_exp(np.array([0.0, 0.0, rng.uniform(-SPREAD_YAW, SPREAD_YAW)]))
    start = hover_state(RotorModel.of(vehicle, problem.gravity), p_WB, so3.quat_multiply(yaw, nominal.start[3:7]))
    start[V] = rng.uniform(-SPREAD_SPEED, SPREAD_SPEED, 3)
    return replace(nominal, start=start)


@dataclass(frozen=True)
class StartScore:
    """What a start is worth.

    Attributes:
        request: the perch from this start.
        plan: its plan, None where it was refused.
        refusal: why, empty where there is a plan.
        seen_share: share of the perch's time in which the camera sees the line.
        duration: of the perch [s]; inf without a plan.
        score: lower is better [s]: time of flying there, of perching, and of not seeing the line, weighted.
    """

    request: PowerlineRequest
    plan: PowerlinePlan | None
    refusal: str
    seen_share: float
    duration: float
    score: float


@dataclass(frozen=True)
class StartSearch:
    """Ring of candidate starts in front of the perch point, and what counts.

    Attributes:
        distances: horizontal, from the perch point [m].
        heights: above the perch point [m].
        bearings: about the vertical, from the line's normal on the present side [rad].
        cruise_speed: of flying to the start [m/s].
        blind_weight: seconds that a second without sight of the line counts for.
    """

    distances: Sequence[float] = (2.5, 3.5, 4.5)
    heights: Sequence[float] = (-0.5, 0.0, 0.5)
    bearings: Sequence[float] = (-0.4, 0.0, 0.4)
    cruise_speed: float = 1.0
    blind_weight: float = 3.0

    def candidates(self, request: PowerlineRequest, vehicle: Vehicle, model: RotorModel, height_min: float
                   ) -> Iterator[PowerlineRequest]:
        """Hovers around the perch point that face it, above the minimum height, the present start first."""
        yield request
        target = request.target()
        grip = request.perch.p_WB - vehicle.wire_offset * request.perch.s3_W
        normal = _normal(target, request.start[P] - grip)
        for distance in self.distances:
            for height in self.heights:
                for bearing in self.bearings:
                    away = so3.exp(np.array([0.0, 0.0, bearing])) @ normal
                    p_WB = grip + distance * away + np.array([0.0, 0.0, height])
                    if p_WB[2] >= height_min:
                        yaw = np.arctan2(-away[1], -away[0])
                        yield replace(request, start=hover_state(model, p_WB, so3.quat_exp(np.array([0.0, 0.0, yaw]))))


def _normal(line: Segment, towards: np.ndarray) -> np.ndarray:
    """Horizontal unit normal of a line on the side of a vector."""
    normal = np.cross(line.direction, [0.0, 0.0, 1.0])
    normal /= np.linalg.norm(normal)
    return normal if normal @ towards >= 0 else -normal


def best_start(request: PowerlineRequest, plan: Callable[[PowerlineRequest], PowerlinePlan], vehicle: Vehicle,
               model: RotorModel, height_min: float, camera: str = "front", search: StartSearch = StartSearch()
               ) -> list[StartScore]:
    """Score candidate starts for a perch: feasible, quick, and with the line in view.

    Args:
        request: the perch, from the present start.
        plan: plans a request or raises PlanningRefusal (`PowerlinePlanner.plan`).
        vehicle: body and cameras.
        model: constants of the vehicle.
        height_min: [m].
        camera: name of the camera that shall see the line.
        search: candidates and weights.

    Returns:
        Every candidate, the best first; refused ones last.
    """
    scores = []
    for candidate in search.candidates(request, vehicle, model, height_min):
        try:
            made = plan(candidate)
        except PlanningRefusal as refusal:
            scores.append(StartScore(candidate, None, str(refusal), 0.0, np.inf, np.inf))
            continue
        seen = float((visibility(made.perch.states[::10], request.target(), vehicle.mounts[camera]).in_image > 0).mean())
        way = float(np.linalg.norm(candidate.start[P] - request.start[P])) / search.cruise_speed
        score = way + made.perch.duration * (1 + search.blind_weight * (1 - seen))
        scores.append(StartScore(candidate, made, "", seen, made.perch.duration, score))
    return sorted(scores, key=lambda item: item.score)
