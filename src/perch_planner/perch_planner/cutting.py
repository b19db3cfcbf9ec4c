"""Linear bounds that steer the next quadratic program away from a violated limit.

A limit on a norm from above, |u| <= b, is convex: `n . u <= b` with n = u / |u| cuts the present plan off and no plan
that keeps the limit. So do height and the surface's plane. The thrust from below, the rim and the body rate are not
convex; their cuts are a choice of side. No plan is believed because of its cuts: every limit is proved afterwards.
"""

from __future__ import annotations

import numpy as np

from perch_core import bernstein
from perch_core.vehicle import GRAVITY
from perch_planner.plan_checks import BODY_RATE, CLEARANCE, HEIGHT, SPEED
from perch_planner.problem import Limits, PerchProblem
from perch_planner.segment_program import Cut

_G = np.array([0.0, 0.0, GRAVITY])
_INF = float("inf")
_KEEP = 0.995       # cuts from above are set to this share of the limit, so that few rounds suffice
_RAISE = 1.02       # cuts of the thrust from below
_HEIGHT_ROOM = 2e-3  # [m]


def _at(coefficients: np.ndarray, durations: np.ndarray, segment: int, place: float, order: int) -> np.ndarray:
    """A time derivative of the position, shape (3,)."""
    return bernstein.evaluate(bernstein.derivative(coefficients[segment], order), place) / durations[segment] ** order


def thrust_cuts(coefficients: np.ndarray, durations: np.ndarray, extrema: np.ndarray, low: float, high: float,
                side: np.ndarray) -> list[Cut]:
    """Cuts where the specific thrust leaves [low, high]. [M:eq16]

    Args:
        coefficients: shape (f, 3, 15).
        durations: shape (f,) [s].
        extrema: of `plan_checks.thrust_extrema`.
        low, high: limits of the specific thrust [m/s^2].
        side: unit vector over which the thrust turns where it nearly vanishes, shape (3,).
    """
    cuts = []
    for i, (_, least, least_at, _, most, most_at) in enumerate(extrema.tolist()):
        if most > high:
            f = _at(coefficients, durations, i, most_at, 2) + _G
            n = f / np.sqrt(f @ f)
            cuts.append(Cut(i, most_at, 2, n, -_INF, _KEEP * high - float(n @ _G)))
        if least < low:
            f = _at(coefficients, durations, i, least_at, 2) + _G
            norm = np.sqrt(f @ f)
            n = f / norm if norm > 0.5 * low else side
            cuts.append(Cut(i, least_at, 2, n, _RAISE * low - float(n @ _G), _INF))
    return cuts


def turning_side(problem: PerchProblem) -> np.ndarray:
    """Direction over which the thrust turns from up to s3: against the heading of the approach, shape (3,)."""
    heading = problem.surface.heading
    return np.array([-np.cos(heading), -np.sin(heading), 0.0])


def limit_cuts(where: np.ndarray, coefficients: np.ndarray, durations: np.ndarray, problem: PerchProblem,
               limits: Limits) -> list[Cut]:
    """Cuts where speed, height, clearance or body rate could not be proved.

    Args:
        where: of `plan_checks.check`.
        coefficients, durations: the plan.
        problem, limits: what was asked.
    """
    cuts = []
    segment, place = int(where[SPEED, 0]), float(where[SPEED, 1])
    if segment >= 0:
        v = _at(coefficients, durations, segment, place, 1)
        cuts.append(Cut(segment, place, 1, v / np.sqrt(v @ v), -_INF, _KEEP * limits.speed))
    segment, place = int(where[HEIGHT, 0]), float(where[HEIGHT, 1])
    if segment >= 0:
        low, high = limits.height
        cuts.append(Cut(segment, place, 0, np.array([0.0, 0.0, 1.0]), low + _HEIGHT_ROOM, high - _HEIGHT_ROOM))
    segment, place = int(where[CLEARANCE, 0]), float(where[CLEARANCE, 1])
    if segment >= 0:
        s3 = problem.surface.normal
        f = _at(coefficients, durations, segment, place, 2) + _G
        tilt = np.linalg.norm(np.cross(f, s3)) / max(np.sqrt(f @ f), 1e-9)
        t = durations[:segment].sum() + place * durations[segment]
        plane = float(s3 @ (problem.surface.p_WS + problem.target_velocity * t))
        cuts.append(Cut(segment, place, 0, s3, plane + 1.1 * limits.extension * min(tilt, 1.0) + _HEIGHT_ROOM, _INF))
    segment, place = int(where[BODY_RATE, 0]), float(where[BODY_RATE, 1])
    if segment >= 0:
        f = _at(coefficients, durations, segment, place, 2) + _G
        norm = np.sqrt(f @ f)
        j = _at(coefficients, durations, segment, place, 3)
        across = j - f * (f @ j) / max(norm, 1e-9) ** 2
        size = np.sqrt(across @ across)
        if size > 1e-6:
            cuts.append(Cut(segment, place, 3, across / size, -_INF, 0.95 * limits.body_rate * norm))
    return cuts
