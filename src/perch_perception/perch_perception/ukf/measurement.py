"""Inputs of the estimator from VIO, outcomes of these inputs, and outputs of the estimator."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np

from perch_core.jit import compiled


class VioOutcome(enum.Enum):
    """Outcome of a VIO pose."""

    STARTED = "the filter started with it"
    APPLIED = "applied at its stamp"
    POSE_ONLY = "applied without its twist, which does not fit: it must be in base_link"
    JUMPED = "applied after a jump: many poses in a row disagreed"
    WAITING = "kept until the IMU has reached its stamp"
    GATED = "refused by the innovation gate"
    BROKEN = "refused: the filter's covariance is not positive definite; it starts again with the next one"
    DUPLICATE = "refused: a pose of this stamp was used before"
    OUT_OF_ORDER = "refused: older than a pose, or a rest, that was used before"
    TOO_OLD = "refused: older than the IMU history"
    FUTURE = "refused: stamp is too far ahead of the IMU, or too many poses wait for the IMU"
    NOT_FINITE = "refused: not finite, or its quaternion is not of length 1"
    BAD_COVARIANCE = "refused: covariance is not positive semi-definite, or too large"
    NO_IMU = "refused: no IMU data yet"

    @property
    def used(self) -> bool:
        """Whether the estimate changed."""
        return self in (VioOutcome.STARTED, VioOutcome.APPLIED, VioOutcome.POSE_ONLY, VioOutcome.JUMPED)


class Health(enum.Enum):
    """State of the estimator; the values are those of perch_msgs/EstimatorStatus."""

    INITIALISING = 0
    RUNNING = 1
    COASTING = 2
    DIVERGED = 3


@dataclass(frozen=True)
class Inertial:
    """VIO's biases and the covariance of its full state.

    Attributes:
        gyro_bias, accel_bias: [rad/s], [m/s^2], shape (3,).
        P: covariance of (p, v, theta, b_g, b_a), theta a rotation vector in B, as in `Estimate`, shape (15, 15).
    """

    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    P: np.ndarray


@dataclass(frozen=True)
class VioPose:
    """A pose of the body from VIO.

    Attributes:
        stamp: middle of the exposure on the IMU's clock [ns].
        p_WB: position [m], shape (3,).
        q_WB: attitude xyzw, shape (4,).
        covariance: of (position [m], rotation about W's axes [rad]), shape (6, 6).
        v_B: velocity in B [m/s], shape (3,), or None.
        velocity_covariance: of the velocity in B, shape (3, 3), or None.
        inertial: VIO's biases and the covariance of its full state, or None; requires `v_B`.
    """

    stamp: int
    p_WB: np.ndarray
    q_WB: np.ndarray
    covariance: np.ndarray
    v_B: np.ndarray | None = None
    velocity_covariance: np.ndarray | None = None
    inertial: Inertial | None = None

    def problem(self) -> VioOutcome | None:
        """Return why the pose cannot be used, or None."""
        state = (self.inertial.gyro_bias, self.inertial.accel_bias, self.inertial.P) if self.inertial else ()
        numbers = [n for n in (self.p_WB, self.q_WB, self.covariance, self.v_B, self.velocity_covariance, *state) if n is not None]
        if not math.isfinite(sum(n.sum() for n in numbers)) or abs(math.hypot(*self.q_WB) - 1) > 1e-3:
            return VioOutcome.NOT_FINITE
        covariances = [C for C in (self.covariance, self.velocity_covariance, *state[2:]) if C is not None]
        return None if all(_is_covariance(np.ascontiguousarray(C)) for C in covariances) else VioOutcome.BAD_COVARIANCE


_MAX_VARIANCE = 1e8  # larger variances carry no information, and their squares would overflow [m^2, rad^2, ...]


@compiled
def _is_covariance(C):
    """Whether a matrix is symmetric and positive semi-definite, up to rounding, and no element exceeds `_MAX_VARIANCE`."""
    scale = np.abs(C).max()
    if scale > _MAX_VARIANCE:
        return False
    if np.abs(C - C.T).max() > 1e-5 * scale + 1e-15:
        return False
    return np.linalg.eigvalsh(C)[0] >= -1e-9 * scale - 1e-15


@dataclass(frozen=True)
class Estimate:
    """The vehicle's state at an IMU stamp.

    Attributes:
        stamp: time [ns].
        p_WB, v_WB: position and velocity in W [m, m/s], shape (3,).
        q_WB: attitude xyzw, shape (4,).
        w_WB_B: angular velocity in B, bias removed [rad/s], shape (3,).
        gyro_bias, accel_bias: [rad/s], [m/s^2], shape (3,).
        P: covariance of (p, v, theta, b_g, b_a), theta a rotation vector in B, shape (15, 15).
    """

    stamp: int
    p_WB: np.ndarray
    v_WB: np.ndarray
    q_WB: np.ndarray
    w_WB_B: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    P: np.ndarray


@dataclass(frozen=True)
class Status:
    """Health and diagnostics of the estimator.

    Attributes:
        health: see `Health`.
        vio_age: time since the stamp of the last applied VIO pose [s]; inf without an estimate.
        accepted, rejected: numbers of VIO poses applied and gated.
        broken: number of divergences: covariance not positive definite, or state not finite; each causes a restart.
        nis, nis_dimension: normalised innovation squared of the last pose that reached the gate, and its dimension.
        position_sigma, attitude_sigma: largest 1 sigma [m], [rad]; inf without an estimate.
        message: human-readable last event, after its uncertainty where the state is too uncertain to be used.
    """

    health: Health
    vio_age: float
    accepted: int
    rejected: int
    broken: int
    nis: float
    nis_dimension: int
    position_sigma: float
    attitude_sigma: float
    message: str
