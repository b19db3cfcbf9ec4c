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
from perch_core.jit import compiled

from perch_perception.ukf import layout as at
from perch_perception.ukf import update_kernels
from perch_perception.ukf.config import VioNoise
from perch_perception.ukf.measurement import VioPose
from perch_perception.ukf.tracklet import split
from perch_perception.ukf.unscented import Belief, CovarianceError


def least_growth(noise: VioNoise, dt: float) -> np.ndarray:
    """Least covariance that the drift gains in dt [s], shape (6, 6)."""
    return _twice_three(noise.drift_position**2 * dt, noise.drift_attitude**2 * dt)


def increment(noise: VioNoise, C_before: np.ndarray, C_now: np.ndarray, dt: float,
              velocity: np.ndarray | None = None) -> np.ndarray:
    """Covariance of the drift's step w between two VIO poses.

    Where C does not grow, VIO has taken back as much as it has drifted, and its error has moved all the same: by its velocity's
    error, which lasts for `velocity_time`. Where C shrinks, VIO has corrected itself, and its pose has stepped by what C has lost.

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
    grown = update_kernels.clipped(C_now - phi * phi * C_before, scale, 1.0)
    return grown + update_kernels.missing(C_before, C_now)


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


def follow(belief: Belief, pose: VioPose, doubt: np.ndarray) -> Belief:
    """Belief with VIO's pose as mean, and as sure of it: what an update took for drift moves the vehicle instead.

    Given all that VIO has used, its errors have mean zero, and it has used the IMU samples of this filter, and the images
    besides. What this filter believes to know of the drift is the same samples with fewer facts. (White noise stays out: the
    pose is p + d after the update.) So VIO's covariance C of the pose x is what is known of it, and the rest keeps what it has: that
    VIO is surer is no news of the biases, and pose after pose would be counted again. With C = P_xx - D + M (`tracklet.split`) that is
    Joseph's form for a measurement with a gain for the pose alone, and M is an error of its own:

        P_x. := (P_xx - D) P_xx^-1 P_x.,   P_xx := C

    What makes VIO surer of the attitude is that it knows its gyro's bias: the part that hangs together with the bias goes first.
    With equal shares of all parts attitude and bias were thought to be one unknown (NEES of both 1.4 after the climb).

    The accelerometer's bias goes with the attitude: a specific force is known better than either, b_a = B theta + c with
    B = P_ba,theta P_theta,theta^-1, and the above is done beside c. Left behind, their sum became unknown, was learned again from the
    velocity, and the bias was believed to be found: NEES 1.5 to 1.8 per dimension at the end of a perch.

    Args:
        belief: after the update.
        pose: with VIO's covariance.
        doubt: what VIO's map may be off beyond its covariance, (position, rotation in W), shape (6, 6).

    Raises:
        CovarianceError: a covariance is not positive definite.
    """
    theta = at.D_ATTITUDE
    x = belief.x.copy()
    turn = update_kernels.take_over_pose(x)
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = np.eye(3), so3.quat_to_matrix(x[at.QUATERNION]).T
    try:
        B = np.linalg.solve(belief.P[theta, theta], belief.P[theta, at.D_ACCEL_BIAS]).T
        x[at.ACCEL_BIAS] += B @ np.array(turn)
        P = _as_sure(belief.P, B, J @ (pose.covariance + doubt) @ J.T)
    except np.linalg.LinAlgError:
        raise CovarianceError("covariance after an update is not positive definite") from None
    return dataclasses.replace(belief, x=x, P=P)


@compiled
def _as_sure(P, B, C):
    """`follow`'s covariance (21, 21), of P (21, 21), B (3, 3) and VIO's C (6, 6) of the errors (position, rotation in B)."""
    n = len(P)
    beside, back, pose = np.eye(n), np.eye(n), np.zeros((6, n))  # indices: `layout`
    beside[12:15, 6:9] = -B
    back[12:15, 6:9] = B
    pose[:3, :3] = pose[3:, 6:9] = np.eye(3)
    P = beside @ P @ beside.T
    own = pose @ P @ pose.T
    D, M = split(own, C)
    gain = np.linalg.solve(own, D).T
    kept = back @ (np.eye(n) - pose.T @ gain @ pose)
    moved = back @ pose.T
    P = kept @ P @ kept.T + moved @ (D - gain @ D + M) @ moved.T
    return 0.5 * (P + P.T)


def white(noise: VioNoise) -> np.ndarray:
    """Covariance of the white part of a VIO pose, shape (6, 6)."""
    return _twice_three(noise.position**2, noise.attitude**2)


def _twice_three(a: float, b: float) -> np.ndarray:
    """Diagonal (a, a, a, b, b, b), shape (6, 6)."""
    out = np.zeros((6, 6))
    out.flat[::7] = a, a, a, b, b, b
    return out
