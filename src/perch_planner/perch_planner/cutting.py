"""Linear bounds that steer the next quadratic program away from a violated limit.

A limit on a norm from above, |u| <= b, is convex: `n . u <= b` with n = u / |u| cuts the present plan off and no plan
that keeps the limit. So do height and the surface's plane. The thrust from below, the rim and the body rate are not
convex; their cuts are a choice of side. No plan is believed because of its cuts: every limit is proved afterwards.
"""

from __future__ import annotations

import numpy as np

from perch_core.vehicle import GRAVITY
from perch_planner.bounds import derivatives_at
from perch_planner.plan_checks import BODY_RATE, CLEARANCE, HEIGHT, SPEED
from perch_planner.problem import Limits, PerchProblem, contact_heading
from perch_planner.rotor_thrusts import linear_bounds
from perch_planner.segment_program import Cut

_UP = np.array([0.0, 0.0, 1.0])
_G = GRAVITY * _UP
_INF = float("inf")
_KEEP = 0.995       # cuts from above are set to this share of the limit, so that few rounds suffice
_KEEP_AHEAD = 0.985  # of the limit, for cuts that are set ahead
_PREVENTED = ((-1, 0.6), (-1, 0.8), (0, 0.0), (0, 0.15))  # segments from the last, places
_LEAN = (0.980, 0.199)  # the thrust leans 11 degrees back where it is greatest
_RAISE = 1.02       # cuts of the thrust from below
_HEIGHT_ROOM = 2e-3  # [m]


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
            f = derivatives_at(coefficients[i], durations[i], most_at, 3)[2] + _G
            n = f / np.sqrt(f @ f)
            cuts.append(Cut(i, most_at, ((2, n),), -_INF, _KEEP * high - float(n @ _G)))
        if least < low:
            f = derivatives_at(coefficients[i], durations[i], least_at, 3)[2] + _G
            norm = np.sqrt(f @ f)
            n = f / norm if norm > 0.5 * low else side
            cuts.append(Cut(i, least_at, ((2, n),), _RAISE * low - float(n @ _G), _INF))
    return cuts


def preventive_cuts(durations: np.ndarray, high: float, side: np.ndarray) -> list[Cut]:
    """Upper thrust bounds where a perch nearly always meets them, before the first program is solved. [M:eq16]

    They hold for every plan that keeps the bound, whatever the direction, and save one round in most plans.

    Args:
        durations: shape (f,) [s].
        high: limit of the specific thrust [m/s^2].
        side: of `turning_side`, shape (3,).
    """
    last = len(durations) - 1
    cuts = []
    for segment, place in _PREVENTED:
        for direction in (_UP, _LEAN[0] * _UP + _LEAN[1] * side):
            if last + segment >= 0:
                cuts.append(Cut(last + segment, place, ((2, direction),), -_INF, _KEEP_AHEAD * high - float(direction @ _G)))
    return cuts


def turning_side(problem: PerchProblem) -> np.ndarray:
    """Direction over which the thrust turns from up to s3: against the heading of the approach, shape (3,)."""
    heading = contact_heading(problem.surface)
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
    for row, (i, s) in enumerate(where.tolist()):
        if i < 0.0 or row not in _LIMIT_CUTS:
            continue
        segment = int(i)
        derivatives = derivatives_at(coefficients[segment], durations[segment], s, 4)
        t = float(durations[:segment].sum() + s * durations[segment])
        cuts += [Cut(segment, s, *bound) for bound in _LIMIT_CUTS[row](derivatives, t, problem, limits)]
    return cuts


def rotor_bounds(thrusts: tuple[np.ndarray, np.ndarray], coefficients: np.ndarray, yaw: np.ndarray, durations: np.ndarray,
                 low: float, high: float, rotors: tuple) -> list[Cut]:
    """Bounds where a rotor's thrust leaves [low, high] [N] or is near to it: linear at the present plan, and good near it.

    Args:
        thrusts: of `rotor_thrusts.sampled`.
        coefficients, yaw, durations: the plan.
        rotors: of `rotor_thrusts.rotor_model`.
    """
    where, gradients, bounds = linear_bounds(*thrusts, coefficients, yaw, durations, low, high, *rotors)
    return [Cut(int(i), s, ((2, g[0]), (3, g[1]), (4, g[2])), lower, upper)
            for (i, s), g, (lower, upper) in zip(where.tolist(), gradients, bounds.tolist())]


def _speed_cut(derivatives, t: float, problem: PerchProblem, limits: Limits):
    v = derivatives[1]
    yield ((1, v / np.sqrt(v @ v)),), -_INF, _KEEP * limits.speed


def _height_cut(derivatives, t: float, problem: PerchProblem, limits: Limits):
    low, high = limits.height
    yield ((0, _UP),), low + _HEIGHT_ROOM, high - _HEIGHT_ROOM


def _clearance_cut(derivatives, t: float, problem: PerchProblem, limits: Limits):
    """The rim's distance at the present tilt: right to first order where the tilt does not change."""
    s3, f = problem.surface.normal, derivatives[2] + _G
    tilt = np.sqrt(max(1.0 - float(f @ s3) ** 2 / max(float(f @ f), 1e-9), 0.0))
    plane = float(s3 @ (problem.surface.p_WS + problem.target_velocity * t))
    yield ((0, s3),), plane + 1.1 * limits.extension * tilt + _HEIGHT_ROOM, _INF


def _rate_cut(derivatives, t: float, problem: PerchProblem, limits: Limits):
    """|j across f| <= W |f|, linear in both at the present directions."""
    f, j = derivatives[2] + _G, derivatives[3]
    norm = max(np.sqrt(f @ f), 1e-9)
    n = f / norm
    across = j - n * (n @ j)
    size = np.sqrt(across @ across)
    if size > 1e-6:
        share = 0.95 * limits.body_rate
        yield ((3, across / size), (2, -share * n)), -_INF, share * float(n @ _G)


_LIMIT_CUTS = {SPEED: _speed_cut, HEIGHT: _height_cut, CLEARANCE: _clearance_cut, BODY_RATE: _rate_cut}
