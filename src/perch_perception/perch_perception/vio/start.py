"""Initial state of the filter at rest: tilt from gravity, gyro bias from the mean rate, position and heading as known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.vehicle import GRAVITY

from perch_perception.ukf.measurement import VioPose
from perch_perception.ukf.stillness import REST_VELOCITY, energy
from perch_perception.ukf.unscented import ACCEL, DT, GYRO
from perch_perception.vio import ekf
from perch_perception.vio import state as at
from perch_perception.vio.config import VioConfig
from perch_perception.vio.preintegration import Preintegration
from perch_perception.vio.state import State


# 1 sigma of (p, heading) as given: they define W, so hardly any; not none, which would make the covariance singular [m, rad]
CONFIGURED_POSE_SIGMA = (0.001, 0.001, 0.001, 0.001)
POSE_ROWS = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])  # position and heading in the covariance of a pose


@dataclass(frozen=True)
class KnownPose:
    """Known position and attitude in W at a start: only the heading of the attitude is used; gravity gives the tilt.

    Attributes:
        p_WB: [m], shape (3,).
        R_WB: shape (3, 3).
        covariance: of (p, heading), shape (4, 4).
        heading_by_bias: derivative of the heading by the gyro bias, where the gyro has propagated it [s], shape (3,).
    """

    p_WB: np.ndarray
    R_WB: np.ndarray
    covariance: np.ndarray
    heading_by_bias: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def turned(self, R_WB: np.ndarray, by_bias: np.ndarray, covariance: np.ndarray) -> KnownPose:
        """Return the pose after a rotation by the gyro.

        Args:
            R_WB: attitude after it, shape (3, 3).
            by_bias: derivative of the rotation vector in B by the gyro bias [s], shape (3, 3).
            covariance: of this vector from the gyro's noise, shape (3, 3).
        """
        P = self.covariance.copy()
        P[3, 3] += R_WB[2] @ covariance @ R_WB[2]
        return replace(self, R_WB=R_WB, covariance=P, heading_by_bias=self.heading_by_bias + R_WB[2] @ by_bias)


def configured_pose(p_WB: np.ndarray, yaw: float) -> KnownPose:
    """Return the pose at the start from a configured position [m], shape (3,), and yaw [rad]."""
    return KnownPose(np.array(p_WB, float), so3.exp(np.array([0.0, 0.0, yaw])), np.diag(np.square(CONFIGURED_POSE_SIGMA)))


def odometry_pose(pose: VioPose) -> KnownPose:
    """Return the pose in the odometry of a running estimator; its covariance is made regular."""
    return KnownPose(pose.p_WB, so3.quat_to_matrix(pose.q_WB), pose.covariance[POSE_ROWS] + np.diag(np.square(CONFIGURED_POSE_SIGMA)))


def positive(covariance: np.ndarray) -> np.ndarray:
    """Return a covariance as it is or, where it is not positive definite, with the magnitudes of its eigenvalues."""
    values, vectors = np.linalg.eigh(covariance)
    return covariance if values[0] > 0.0 else (vectors * np.abs(values)) @ vectors.T


def levelled(R_WB: np.ndarray, up_B: np.ndarray) -> np.ndarray:
    """Return the attitude nearest to R_WB in which a direction in B, shape (3,), points up."""
    up_W = R_WB @ (up_B / np.linalg.norm(up_B))
    axis = np.array([up_W[1], -up_W[0], 0.0])  # up_W x e3
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return R_WB if up_W[2] > 0.0 else so3.exp(np.array([np.pi, 0.0, 0.0])) @ R_WB
    return so3.exp(axis * (np.arctan2(sine, up_W[2]) / sine)) @ R_WB


def initial_state(config: VioConfig, mount: CameraMount, stamp: int, R_WB: np.ndarray, pose: KnownPose, v_WB: np.ndarray,
          gyro_bias: np.ndarray, tilt_sigma: float, velocity_sigma: float, gyro_sigma: float) -> State:
    """Return a state without clones; attitude uncertainty is `tilt_sigma` about the horizontal axes and the pose's about z."""
    c = config.calibration
    P = np.zeros((at.CORE_SIZE, at.CORE_SIZE))
    # theta = R^T (tilt_x, tilt_y, yaw): the pose's covariance couples yaw and position
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = R_WB.T, np.eye(3)
    W = np.zeros((6, 6))
    W[0, 0] = W[1, 1] = tilt_sigma**2
    W[2, 2], W[3:, 3:] = pose.covariance[3, 3], pose.covariance[:3, :3]
    W[2, 3:] = W[3:, 2] = pose.covariance[3, :3]
    P[:6, :6] = J @ W @ J.T
    sigma = np.concatenate([np.repeat([velocity_sigma, gyro_sigma, config.imu.accel_bias_init, c.rotation, c.translation], 3),
                            [c.time_offset, c.focal, c.focal, c.centre / mount.camera.fx, c.centre / mount.camera.fy]])
    P[6:, 6:] = np.diag(sigma**2)
    return State(stamp, R_WB, pose.p_WB.copy(), v_WB, gyro_bias, np.zeros(3), mount.R_BC.copy(), mount.p_BC.copy(),
                 -mount.stamp_offset, P)


def at_rest(config: VioConfig, mount: CameraMount, stamp: int, steps: np.ndarray, pose: KnownPose) -> State:
    """Return the state of a vehicle that stood still over IMU steps (m, 9).

    Tilt and accelerometer bias cannot be separated at rest: the update with the mean force yields exactly this correlation.
    """
    gyro, accel = steps[:, GYRO].mean(axis=0), steps[:, ACCEL].mean(axis=0)
    R_WB = levelled(pose.R_WB, accel)
    imu, T = config.imu, steps[:, DT].sum()
    noise_factor = max(1.0, energy(steps))
    gyro_sigma = imu.gyro_noise_density * np.sqrt(noise_factor / T)
    state = initial_state(config, mount, stamp, R_WB, pose, np.zeros(3), gyro, 0.2, REST_VELOCITY, gyro_sigma)
    # a bias that shows along g is, as far as anybody knows, no smaller across it
    accel_sigma = max(imu.accel_bias_init, abs(float(np.linalg.norm(accel)) - GRAVITY))
    state.P[at.ACCEL_BIAS, at.ACCEL_BIAS] = accel_sigma**2 * np.eye(3)
    up_B = R_WB.T @ np.array([0.0, 0.0, GRAVITY])
    H = np.zeros((3, at.INERTIAL_SIZE))
    H[:, at.THETA], H[:, at.ACCEL_BIAS] = so3.hat(up_B), np.eye(3)
    dx, state.P, _ = ekf.update(state.P, np.arange(at.INERTIAL_SIZE), H, accel - up_B, imu.accel_noise_density**2 * noise_factor / T)
    state.inject(dx)
    add_heading_by_bias(state, pose)
    return state


def add_heading_by_bias(state: State, pose: KnownPose) -> None:
    """Add to a start's attitude, theta = R^T e3 (u b_g), the error of a heading that the gyro has propagated: u = `heading_by_bias`."""
    F = np.eye(len(state.P))
    F[at.THETA, at.GYRO_BIAS] = np.outer(state.R_WB[2], pose.heading_by_bias)
    state.P = F @ state.P @ F.T


def propagate_position(state: State, since: Preintegration) -> None:
    """Propagate the position of a start from where it was last known, by the IMU since and the start's velocity and attitude.

    With p' = p + v T + g T^2/2 + R dp, v' = v + g T + R dv and R = R' dR^T of the start (R', v', p'):
    p' - p = v' T - g T^2/2 - R' u,  u = dR^T (T dv - dp).
    """
    T, R = since.duration, state.R_WB
    u = since.dR.T @ (T * since.dv - since.dp)
    state.p_WB += T * state.v_WB + (0.0, 0.0, 0.5 * GRAVITY * T**2) - R @ u
    F = np.eye(len(state.P))
    F[at.POSITION, at.VELOCITY], F[at.POSITION, at.THETA] = T * np.eye(3), R @ so3.hat(u)
    by_motion = -R @ np.hstack([so3.hat(u), -since.dR.T, T * since.dR.T])  # derivative by (log dR, dp, dv)
    F[at.POSITION, at.GYRO_BIAS.start:at.ACCEL_BIAS.stop] = by_motion @ since.J
    state.P = F @ state.P @ F.T
    state.P[at.POSITION, at.POSITION] += by_motion @ since.Q @ by_motion.T
