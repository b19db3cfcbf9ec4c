"""VIO's error in time: a Gauss-Markov drift with VIO's own covariance, plus a little white noise.

A VIO pose is not an independent measurement. Its error hardly changes from frame to frame, and a filter that takes 30 such
poses a second for independent ones divides a drift of centimetres by sqrt(30) every second. So the filter models

    z_k = pose_k (+) d_k (+) n_k,     d_k = phi d_(k-1) + w_k,     phi = exp(-dt / tau),
    Cov(w_k) = C_k - phi^2 C_(k-1)  (eigenvalues not below a floor),     Cov(n_k) = white,

with C_k the covariance that VIO reports. Then Cov(d_k) = C_k for every k, and the difference of two poses is as good
as VIO says it is while their common error stays in the state's covariance.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from perch_core import so3

from perch_perception.ukf import layout as at
from perch_perception.ukf import update_kernels
from perch_perception.ukf.config import VioNoise
from perch_perception.ukf.measurement import VioPose
from perch_perception.ukf.unscented import Belief, CovarianceError

_POSE = np.r_[at.D_POSITION, at.D_ATTITUDE]


def least_growth(noise: VioNoise, dt: float) -> np.ndarray:
    """Least covariance that the drift gains in dt [s], shape (6, 6)."""
    return np.diag(np.repeat([noise.drift_position**2 * dt, noise.drift_attitude**2 * dt], 3))


def increment(noise: VioNoise, C_before: np.ndarray, C_now: np.ndarray, dt: float,
              velocity: np.ndarray | None = None) -> np.ndarray:
    """Covariance of the drift's step w between two VIO poses.

    Where C does not grow, VIO has taken back as much as it has drifted, and its error has moved all the same: by its velocity's
    error, which lasts for `velocity_time`.

    Args:
        noise: the drift's parameters.
        C_before, C_now: covariances reported with the poses, shape (6, 6).
        dt: time between them [s].
        velocity: covariance of VIO's velocity in W, shape (3, 3), or None.

    Returns:
        Positive definite matrix, shape (6, 6).
    """
    phi = kept(noise, dt)
    floor = least_growth(noise, dt)
    if velocity is not None:
        floor[:3, :3] += np.diag(np.diag(velocity)) * noise.velocity_time * dt
    scale = np.sqrt(np.diag(floor)) + 1e-9
    # eigenvalues in units of the floor, so that metres and radians are not compared
    return update_kernels.clipped(C_now - phi * phi * C_before, scale, 1.0)


def kept(noise: VioNoise, dt: float) -> float:
    """Share of the drift that is left after dt [s]."""
    return math.exp(-dt / noise.correlation_time)


def advance(belief: Belief, noise: VioNoise, W: np.ndarray, dt: float) -> Belief:
    """Belief with the drift moved on by dt [s]: exact, because the drift is linear."""
    phi = kept(noise, dt)
    x, P = belief.x.copy(), belief.P.copy()
    x[at.DRIFT] *= phi
    P[at.D_DRIFT, :] *= phi
    P[:, at.D_DRIFT] *= phi
    P[at.D_DRIFT, at.D_DRIFT] += W
    return dataclasses.replace(belief, x=x, P=P)


def follow(belief: Belief, pose: VioPose, velocity: bool) -> Belief:
    """Belief with VIO's pose, and its velocity, as mean: what an update took for drift moves the vehicle instead.

    Given all that VIO has used, its errors have mean zero, and it has used the IMU samples of this filter, and the images
    besides. What this filter believes to know of the drift is the same samples with fewer facts. (White noise stays out: the
    pose is p + d after the update.) Velocities are compared in B, where VIO measures them and both turn with the same attitude:
    the error of v less what the attitude makes of it, u = dv - A theta (see `as_sure_as`). Of it VIO's covariance C decides: u
    moves by P_uu (P_uu + max(0, C - P_uu))^-1 of the difference, which is all of it unless VIO has just started anew; the biases
    follow as they are correlated with u.
    """
    x, P = belief.x.copy(), belief.P
    x[at.POSITION] += x[16:19]
    x[at.QUATERNION] = update_kernels.vios_attitude(x)
    x[at.DRIFT] = 0.0
    if velocity and pose.v_WB is not None and pose.velocity_covariance is not None:
        U = _beside_attitude(x)
        P_u = U @ P
        own = P_u @ U.T
        weighed = np.linalg.solve(own + update_kernels.missing(pose.velocity_covariance, own), pose.v_WB - x[at.VELOCITY])
        x[at.VELOCITY] += own @ weighed
        x[at.GYRO_BIAS] += weighed @ P_u[:, at.D_GYRO_BIAS]
        x[at.ACCEL_BIAS] += weighed @ P_u[:, at.D_ACCEL_BIAS]
    return dataclasses.replace(belief, x=x)


def _beside_attitude(x: np.ndarray) -> np.ndarray:
    """U, shape (3, 21), for the velocity's error beside what the attitude's makes of it, u = dv - A theta, A = -[v]x R."""
    U = np.zeros((3, at.ERROR_SIZE))
    U[:, at.D_VELOCITY] = np.eye(3)
    U[:, at.D_ATTITUDE] = so3.hat(x[at.VELOCITY]) @ so3.quat_to_matrix(x[at.QUATERNION])
    return U


def as_sure_as(belief: Belief, pose: VioPose, doubt: np.ndarray) -> Belief:
    """Belief whose pose and velocity are as sure as VIO's.

    VIO has used the very IMU samples that this filter integrates, and the images besides: its covariance C of the pose is what is
    known of it. Where P is smaller in some direction, the difference is added, as an error of its own; where it is larger, it
    shrinks, and correlations stay. The biases keep their covariance: that VIO is surer is no news of them, and pose after pose
    would be counted again. For x = pose:

        P_xx := P_xx + max(0, C - P_xx);   P' = T P T^T,   T_xx = L(C) L(P_xx)^-1,   C = L(C) L(C)^T.

    Of the velocity VIO speaks in B, where the camera measures it: in W it is as wrong, besides, as the attitude that turns it,
    v = R v_B, and so hangs together with it and with all that the attitude does. With C_v of v_B in W's axes:

        dv = A theta + n,   A = -[v]x R,   P_v. := A P_theta.,   P_vv := A P_theta,theta A^T + C_v

    Args:
        belief: after the update.
        pose: with VIO's covariances.
        doubt: what VIO's map may be off beyond its covariance, (position, rotation in W), shape (6, 6).

    Raises:
        CovarianceError: a covariance is not positive definite.
    """
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = np.eye(3), so3.quat_to_matrix(belief.x[at.QUATERNION]).T
    P, T = belief.P.copy(), np.eye(at.ERROR_SIZE)
    if not update_kernels.as_sure_as(P, _POSE, J @ (pose.covariance + doubt) @ J.T, T):
        raise CovarianceError("covariance after an update is not positive definite")
    P = T @ P @ T.T
    if pose.velocity_covariance is not None:
        A = -_beside_attitude(belief.x)[:, at.D_ATTITUDE]
        P[at.D_VELOCITY, :] = A @ P[at.D_ATTITUDE, :]
        P[:, at.D_VELOCITY] = P[at.D_VELOCITY, :].T
        P[at.D_VELOCITY, at.D_VELOCITY] = A @ P[at.D_ATTITUDE, at.D_ATTITUDE] @ A.T + pose.velocity_covariance
    return dataclasses.replace(belief, P=0.5 * (P + P.T))


def white(noise: VioNoise) -> np.ndarray:
    """Covariance of the white part of a VIO pose, shape (6, 6)."""
    return np.diag(np.repeat([noise.position**2, noise.attitude**2], 3))
