"""Initial durations of the segments, and their growth."""

from __future__ import annotations

from math import sqrt

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_planner.problem import PerchProblem, PerchSettings

CRUISE_SPEED = 2.2        # [m/s] of the speed profile that spaces the waypoints
CRUISE_ACCELERATION = 2.8  # [m/s^2]
TURN_ACCELERATION = 1.2    # [m/s^2]
FINAL_TIME = 0.45          # [s] of the last piece, where the rotation happens
FINE_DIVISIONS = (np.array([0.26, 0.2, 0.2]), np.array([0.375, 0.25]))  # [s] last pieces where the rotation takes all that the rotors have
PIECE_MAX = 1.8           # [s] of the pieces before it
APPROACH_TIME = 1.2       # [s] after the last waypoint, for run-up and rotation
GUESS_SHARE_MIN = 0.8     # of the profile's duration to a waypoint: a shorter guess leads to longer plans in most cases
SEGMENT_MIN = 0.12        # [s]; shorter ones make the cost ill-conditioned
LAST_SEGMENT_MIN = 0.25   # [s]; a shorter rotation is often infeasible
_ROUNDING = 1e-9           # [s] of sums


@compiled
def _distance(a: Array, b: Array) -> float:
    return sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@compiled
def _direction_change(points: Array, legs: Array, i: int) -> float:
    """Length of the difference between the directions of legs i and i + 1."""
    squared = 0.0
    for d in range(3):
        squared += ((points[i + 2, d] - points[i + 1, d]) / legs[i + 1] - (points[i + 1, d] - points[i, d]) / legs[i]) ** 2
    return sqrt(squared)


@compiled
def _along_waypoints(points: Array, v_start: Array, v_end: Array, speed: float, acceleration: float, turn_acceleration: float,
                     last_min: float) -> Array:
    """Durations between points, from a trapezoidal speed profile over the whole way.

    The profile is slowed down for the turns and lengthened for the difference of the end velocities. The speed at a waypoint
    is bounded by v^2 = A l / turn, with the shorter leg l and the change of direction there.
    """
    n = len(points) - 1
    extra = _distance(v_end, v_start) / acceleration
    legs = np.empty(n)
    for i in range(n):
        legs[i] = max(_distance(points[i + 1], points[i]), 1e-6)
    length = legs.sum()
    ramp = min(speed**2 / acceleration, length) / 2.0
    peak = np.sqrt(2.0 * acceleration * ramp)
    total = 2.0 * peak / acceleration + (length - 2.0 * ramp) / peak
    out = np.empty(n)
    reached, before, slow = 0.0, 0.0, speed
    for i in range(n):
        reached += legs[i]
        d = max(min(reached, length - reached), 0.0)
        near = np.sqrt(2.0 * d / acceleration) if d <= ramp else peak / acceleration + (d - ramp) / peak
        now = near if reached <= 0.5 * length else total - near
        fast = speed
        if i < n - 1:
            turn = _direction_change(points, legs, i)
            fast = min(np.sqrt(turn_acceleration * min(legs[i], legs[i + 1]) / max(turn, 1e-6)), speed)
        out[i] = max(now - before, 2.0 * legs[i] / (slow + fast))
        before, slow = now, fast
    stretch = 1.0 + extra / out.sum()
    for i in range(n):
        out[i] = max(stretch * out[i], SEGMENT_MIN)
    out[n - 1] = max(max(out[n - 1], APPROACH_TIME), last_min)
    return out


def allocate(problem: PerchProblem, settings: PerchSettings, points: np.ndarray) -> np.ndarray:
    """Durations of a speed profile along the waypoints.

    Args:
        problem: start, waypoints, target velocity.
        settings: its tube time is a lower bound of the last segment.
        points: start, waypoints, and the contact with a static target [m], shape (waypoints + 2, 3).

    Returns:
        Durations [s], shape (len(waypoints) + 1,).
    """
    return _along_waypoints(points, problem.start.v, problem.target_velocity, CRUISE_SPEED, CRUISE_ACCELERATION,
                            TURN_ACCELERATION, max(settings.tube_time, LAST_SEGMENT_MIN))


def initial_durations(problem: PerchProblem, settings: PerchSettings, allocated: np.ndarray) -> np.ndarray:
    """Durations from which a search begins: those of the problem, where they are not far too short, or else the allocated ones.

    Durations only grow, all by one factor where a leg to a waypoint is too short: a short one would make all others long.
    """
    if problem.segment_times is None:
        return allocated
    guess = np.array(problem.segment_times)
    guess[:-1] = np.maximum(guess[:-1], GUESS_SHARE_MIN * allocated[:-1])
    return with_last_segment(guess, settings)


def with_last_segment(durations: np.ndarray, settings: PerchSettings) -> np.ndarray:
    """Return the durations with a last segment that is long enough for the tube: a shorter one is often infeasible."""
    durations = durations.copy()
    durations[-1] = max(durations[-1], settings.tube_time, LAST_SEGMENT_MIN)
    return durations


def shortened(durations: np.ndarray, settings: PerchSettings) -> np.ndarray | None:
    """Scale longer durations down to `duration_max`, by one factor except for the least last segment; None: they do not fit."""
    out = with_last_segment((settings.duration_max - _ROUNDING) / durations.sum() * durations, settings)
    before, room = out[:-1], settings.duration_max - out[-1]
    if room < SEGMENT_MIN * len(before):
        return None
    if len(before):
        before *= (room - _ROUNDING) / before.sum()
    return out


@compiled
def split_last(durations: Array) -> Array:
    """Divide a long last segment by knots without conditions.

    One polynomial over a long way is too stiff for the rotation at its end: without the knot no plan keeps the thrust of
    a 0.25 kg vehicle below 4.05 N at inclinations above 105 degrees; with it every inclination is reached.
    """
    last, before = durations[-1], len(durations) - 1
    if last < 2.0 * FINAL_TIME:
        return durations.copy()
    if last < 5.0 * FINAL_TIME:
        out = np.empty(before + 2)
        out[before], out[before + 1] = last - FINAL_TIME, FINAL_TIME
    else:
        run_up = last - 2.5 * FINAL_TIME
        pieces = int(np.ceil(run_up / PIECE_MAX))
        out = np.empty(before + pieces + 2)
        out[before:] = run_up / pieces
        out[-2], out[-1] = 1.5 * FINAL_TIME, FINAL_TIME
    out[:before] = durations[:before]
    return out


def split_finely(durations: Array, pieces: Array) -> Array:
    """Divide the last segment so that it ends with given pieces [s], with knots without conditions.

    With one polynomial for the 0.45 s of the rotation, the rotor limits bind at one instant and are not used elsewhere; shorter
    pieces follow the limits more closely.
    """
    run_up, before = durations[-1] - pieces.sum(), len(durations) - 1
    if run_up < FINAL_TIME:
        return split_last(durations)
    count = int(np.ceil(run_up / PIECE_MAX))
    out = np.empty(before + count + len(pieces))
    out[:before], out[before:before + count], out[before + count:] = durations[:before], run_up / count, pieces
    return out


def lengthen_approach(durations: np.ndarray, factor: float) -> np.ndarray:
    """Lengthen the last segment, which holds the run-up and the rotation, and slightly the others."""
    grown = 1.05 * durations
    grown[-1] = max(factor * durations[-1], 2.2 * FINAL_TIME)
    return grown


def stretch_factor(peak: float, limit: float) -> float:
    """Factor on all durations that brings a peak specific thrust near its limit. [M:IV-C.3]

    Accelerations fall with the square of time while gravity stays, hence sqrt((peak - g) / (limit - g)); bounded to
    [1.05, 1.6], because the terminal conditions do not scale with it.

    Args:
        peak: largest specific thrust of the plan [m/s^2].
        limit: its bound [m/s^2].
    """
    if limit <= GRAVITY:
        return 1.1
    return min(max(sqrt(max(peak - GRAVITY, 0.0) / (limit - GRAVITY)), 1.05), 1.6)
