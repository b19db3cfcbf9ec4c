"""Initial guesses: where the interior-point method starts decides which local minimum it finds.

A quintic in position with the tilt turned over the last half converges from every start that was tried. The paper's hover
guess finds minima on the wrong side of the line, and a flat minimum-snap trajectory flies through it.
"""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.rotor_model import INPUTS, STATES, RotorModel
from perch_planner.powerline.stage_functions import STAGE_STATES

E3 = np.array([0.0, 0.0, 1.0])


def smooth(s: np.ndarray) -> np.ndarray:
    """Quintic from 0 to 1 with zero slope and curvature at both ends."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def turn_axis(b3_W: np.ndarray, s3_W: np.ndarray, lean_W: np.ndarray) -> tuple[np.ndarray, float]:
    """Axis and angle that turn b3 into s3, leaning towards `lean_W` where both are opposite.

    Args:
        b3_W, s3_W: unit vectors in W, shape (3,).
        lean_W: where b3 shall pass when the turn is a half one, shape (3,).
    """
    axis = np.cross(b3_W, s3_W)
    angle = float(so3.angle_between(b3_W, s3_W))
    if np.linalg.norm(axis) < 1e-3:
        axis = np.cross(b3_W, lean_W - (lean_W @ b3_W) * b3_W)
    norm = np.linalg.norm(axis)
    return (axis / norm if norm > 1e-9 else np.array([1.0, 0.0, 0.0])), angle


def perch_duration(start: np.ndarray, p_end: np.ndarray) -> float:
    """First guess of T [s] for a perch over a distance."""
    return max(1.2, 0.9 + 0.3 * float(np.linalg.norm(p_end - start[:3])))


def facing_turn(q_WB: np.ndarray, q_BC: np.ndarray, towards_W: np.ndarray) -> float:
    """Yaw that turns the camera's horizontal heading into that of a direction [rad]; 0 where either is vertical."""
    axis_W = so3.quat_rotate(q_WB, so3.quat_rotate(q_BC, E3))
    if min(np.linalg.norm(axis_W[:2]), np.linalg.norm(towards_W[:2])) < 1e-3:
        return 0.0
    turn = np.arctan2(towards_W[1], towards_W[0]) - np.arctan2(axis_W[1], axis_W[0])
    return float((turn + np.pi) % (2 * np.pi) - np.pi)


def perch_guess(model: RotorModel, start: np.ndarray, p_end: np.ndarray, s3_W: np.ndarray, height_min: float,
                intervals: int, duration: float | None = None, yaw_turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Quintic in position, tilt turned over the last half.

    Args:
        model: constants.
        start: state, shape (17,).
        p_end: wanted end position in W [m], shape (3,).
        s3_W: wanted direction of b3 at the end, shape (3,).
        height_min: the guess stays above [m].
        intervals: N.
        duration: T [s]; chosen by distance when None.
        yaw_turn: turn about the vertical in the first quarter, to look at the line [rad].

    Returns:
        States and inputs, shapes (N + 1, 18) and (N, 4).
    """
    s = np.linspace(0.0, 1.0, intervals + 1)
    T = perch_duration(start, p_end) if duration is None else duration
    states = np.zeros((intervals + 1, STAGE_STATES))
    way = p_end - start[:3]
    states[:, :3] = start[:3] + smooth(s)[:, None] * way
    states[:, 7:10] = (30 * s**2 * (1 - s) ** 2)[:, None] * way / T
    states[:, 2] = np.maximum(states[:, 2], height_min)
    b3_W = so3.quat_to_matrix(start[3:7])[:, 2]
    axis, angle = turn_axis(b3_W, s3_W, -way)  # braking leans b3 back, away from the line
    turn = so3.quat_exp(smooth(2 * s - 1)[:, None] * angle * axis)
    yaw = so3.quat_exp(smooth(4 * s)[:, None] * yaw_turn * E3)
    states[:, 3:7] = so3.quat_multiply(turn, so3.quat_multiply(yaw, start[3:7]))
    states[:, 13:17] = model.hover
    states[:, STATES] = T
    states[0, :STATES] = start
    return states, np.zeros((intervals, INPUTS))


def recovery_guess(model: RotorModel, start: np.ndarray, p_end: np.ndarray, height_min: float, intervals: int,
                   duration: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Away from the line along b3, falling while upside down, upright after 60 % of the time.

    Args and returns as `perch_guess`, with b3 = e3 at the end.
    """
    s = np.linspace(0.0, 1.0, intervals + 1)
    states = np.zeros((intervals + 1, STAGE_STATES))
    b3_W = so3.quat_to_matrix(start[3:7])[:, 2]
    way = p_end - start[:3]
    axis, angle = turn_axis(b3_W, E3, way)
    drop = 0.8 * angle / np.pi
    states[:, :3] = start[:3] + smooth(s)[:, None] * (0.25 * way + 0.3 * b3_W - drop * E3)
    states[:, 2] = np.maximum(states[:, 2], height_min)
    states[:, 3:7] = so3.quat_multiply(so3.quat_exp(smooth(s / 0.6)[:, None] * angle * axis), start[3:7])
    states[:, 13:17] = model.hover
    states[:, STATES] = duration
    states[0, :STATES] = start
    return states, np.zeros((intervals, INPUTS))
