"""Initial guesses, which determine the local minimum that the interior-point method finds.

A quintic in position with the tilt in the last half converges from every start that was tried. The paper's hover guess
leads to minima on the wrong side of the line, and a flat minimum-snap trajectory passes through the line.
"""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.rotor_model import INPUTS, STATES, RotorModel
from perch_planner.powerline.stage_functions import STAGE_STATES

E3 = np.array([0.0, 0.0, 1.0])
NEARLY_OPPOSITE = np.radians(150.0)
SIDE_TURN = 0.5  # turn about b3 by which a perch with the line in view begins on one side [rad]


def smootherstep(s: np.ndarray) -> np.ndarray:
    """Quintic from 0 to 1 with zero slope and curvature at both ends."""
    s = np.clip(s, 0.0, 1.0)
    rising: np.ndarray = s**3 * (10 - 15 * s + 6 * s**2)
    return rising


def coasting(s: np.ndarray) -> np.ndarray:
    """Quintic from 0 to 0 with slope one at the start, and zero curvature at both ends and slope at the other."""
    moving: np.ndarray = s - 6 * s**3 + 8 * s**4 - 3 * s**5
    return moving


def turn_axis(b3_W: np.ndarray, s3_W: np.ndarray, via_W: np.ndarray) -> tuple[np.ndarray, float]:
    """Axis and angle that turn b3 into s3: the shortest way, or, where both are nearly opposite, the way through `via_W`.

    Every axis in the plane of b3 x s3 and b3 + s3 turns b3 into s3. For an upside-down perch on a wire that is inclined by
    one degree, the shortest way leads sideways, along the wire, unlike the way of the manoeuvre.

    Args:
        b3_W, s3_W: unit vectors in W, shape (3,).
        via_W: direction through which b3 turns where the angle is near 180 degrees, shape (3,); zero or along b3: the shortest way.
    """
    across, angle = np.cross(b3_W, s3_W), float(so3.angle_between(b3_W, s3_W))
    axis = across
    if angle > NEARLY_OPPOSITE:
        preferred_axis = np.cross(b3_W, via_W)
        plane = [v / np.linalg.norm(v) for v in (across, b3_W + s3_W) if np.linalg.norm(v) > 1e-9]
        through_via = sum((preferred_axis @ v) * v for v in plane) if plane else preferred_axis
        axis = through_via if np.linalg.norm(through_via) > 1e-9 else across
    norm = np.linalg.norm(axis)
    if norm < 1e-9:
        return np.array([1.0, 0.0, 0.0]), angle
    axis = axis / norm
    before, after = (v - (v @ axis) * axis for v in (b3_W, s3_W))
    return axis, float(np.arctan2(axis @ np.cross(before, after), before @ after) % (2 * np.pi))


def body_rates(q_WB: np.ndarray, duration: float) -> np.ndarray:
    """Body rates from attitudes at equal time steps, by differences [rad/s], shape (N + 1, 3).

    With zero rates, turning attitudes would be an inconsistent guess: the solver's first steps shrink to a tenth, and a
    recovery at 80 deg takes 36 iterations instead of 24.
    """
    turns = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q_WB[:-1]), q_WB[1:])) * (len(q_WB) - 1) / duration
    return 0.5 * (np.vstack([turns[:1], turns]) + np.vstack([turns, turns[-1:]]))


def perch_duration(start: np.ndarray, p_end: np.ndarray) -> float:
    """First guess of T [s] for a perch, from the distance of its end."""
    return max(1.2, 0.9 + 0.3 * float(np.linalg.norm(p_end - start[:3])))


def facing_turn(q_WB: np.ndarray, q_BC: np.ndarray, towards_W: np.ndarray) -> float:
    """Yaw that turns the camera's horizontal heading into that of a direction [rad]; 0 where either is vertical."""
    axis_W = so3.quat_rotate(q_WB, so3.quat_rotate(q_BC, E3))
    if min(np.linalg.norm(axis_W[:2]), np.linalg.norm(towards_W[:2])) < 1e-3:
        return 0.0
    turn = np.arctan2(towards_W[1], towards_W[0]) - np.arctan2(axis_W[1], axis_W[0])
    return float((turn + np.pi) % (2 * np.pi) - np.pi)


def side_turn(q_WB: np.ndarray, q_BC: np.ndarray, line_W: np.ndarray, towards_W: np.ndarray) -> float:
    """Turn about b3 towards the side of the line's normal on which the camera axis already lies [rad].

    With the line in view a perch ends with the camera turned along the wire, to the left or to the right. A guess between
    both lies on a ridge of the cost, and the solver takes three times the iterations to leave it.

    Args:
        q_WB, q_BC: attitude of the body in W, and of the camera on the body, xyzw, shape (4,).
        line_W: direction of the line, shape (3,).
        towards_W: from the vehicle to the line, shape (3,).
    """
    normal_W = np.cross(line_W, E3)
    normal_W = normal_W if normal_W @ towards_W >= 0 else -normal_W
    return -SIDE_TURN if facing_turn(q_WB, q_BC, normal_W) >= 0 else SIDE_TURN


def perch_guess(model: RotorModel, start: np.ndarray, p_end: np.ndarray, s3_W: np.ndarray, height_min: float,
                intervals: int, duration: float | None = None, yaw_turn: float = 0.0, b3_turn: float = 0.0
                ) -> tuple[np.ndarray, np.ndarray]:
    """Initial guess of a perch: quintic in position, tilt in the last half.

    Args:
        model: constants.
        start: state, shape (17,).
        p_end: required end position in W [m], shape (3,).
        s3_W: required direction of b3 at the end, shape (3,).
        height_min: least height of the guess [m].
        intervals: N.
        duration: T [s]; chosen by distance when None.
        yaw_turn: turn about the vertical in the first quarter, towards the line [rad].
        b3_turn: turn about b3 until the end [rad].

    Returns:
        States and inputs, shapes (N + 1, 18) and (N, 4).
    """
    s = np.linspace(0.0, 1.0, intervals + 1)
    T = perch_duration(start, p_end) if duration is None else duration
    states = np.zeros((intervals + 1, STAGE_STATES))
    way = p_end - start[:3]
    states[:, :3] = start[:3] + smootherstep(s)[:, None] * way
    states[:, 7:10] = (30 * s**2 * (1 - s) ** 2)[:, None] * way / T
    states[:, 2] = np.maximum(states[:, 2], height_min)
    b3_W = so3.quat_to_matrix(start[3:7])[:, 2]
    axis, angle = turn_axis(b3_W, s3_W, -way)  # braking leans b3 back, away from the line
    turn = so3.quat_exp(smootherstep(2 * s - 1)[:, None] * angle * axis)
    yaw = so3.quat_exp(smootherstep(4 * s)[:, None] * yaw_turn * E3)
    side = so3.quat_exp(smootherstep(s)[:, None] * b3_turn * E3)
    states[:, 3:7] = so3.quat_multiply(turn, so3.quat_multiply(so3.quat_multiply(yaw, start[3:7]), side))
    states[:, 10:13] = body_rates(states[:, 3:7], T)
    states[:, 13:17] = model.hover
    states[:, STATES] = T
    states[0, :STATES] = start
    return states, np.zeros((intervals, INPUTS))


def recovery_guess(model: RotorModel, start: np.ndarray, p_end: np.ndarray, height_min: float, intervals: int,
                   duration: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Initial guess of a recovery: with the start's velocity at first, away from the line along b3, with a drop while upside down, upright
    after 60 % of the time.

    Args and returns as `perch_guess`, with b3 = e3 at the end.
    """
    s = np.linspace(0.0, 1.0, intervals + 1)
    states = np.zeros((intervals + 1, STAGE_STATES))
    b3_W = so3.quat_to_matrix(start[3:7])[:, 2]
    way = p_end - start[:3]
    axis, angle = turn_axis(b3_W, E3, way)
    drop = 0.8 * angle / np.pi
    states[:, :3] = start[:3] + smootherstep(s)[:, None] * (0.25 * way + 0.3 * b3_W - drop * E3) + coasting(s)[:, None] * duration * start[7:10]
    states[:, 2] = np.maximum(states[:, 2], height_min)
    states[:, 7:10] = np.gradient(states[:, :3], duration / intervals, axis=0)
    states[:, 3:7] = so3.quat_multiply(so3.quat_exp(smootherstep(s / 0.6)[:, None] * angle * axis), start[3:7])
    states[:, 10:13] = body_rates(states[:, 3:7], duration)
    states[:, 13:17] = model.hover
    states[:, STATES] = duration
    states[0, :STATES] = start
    return states, np.zeros((intervals, INPUTS))
