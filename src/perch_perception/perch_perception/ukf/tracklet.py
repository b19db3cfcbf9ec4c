"""VIO's velocity as this filter's own prediction and one measurement more: the one that VIO has made and the filter has not.

VIO integrates the very IMU samples that this filter integrates, and sees images besides. What it says of the velocity, its (v_VIO, C),
is therefore the prediction (v, P_vv) after a measurement of v with the noise R, C = P_vv - P_vv (P_vv + R)^-1 P_vv. Nothing of R is
needed: with z and R put into Kalman's equations all that hangs together with v becomes

    y = v_VIO - v,   D = P_vv - C,   G = P_.v P_vv^-1,   x := x + G y,   P := P - G D G^T.

The biases so learn as much as images have made VIO surer, once. Where VIO flies blind C grows as P_vv does, D vanishes, and nothing
is learned from its echo of the same samples. (Drummond's tracklets: an estimate that has been passed on is no independent measurement.)
"""

from __future__ import annotations

import dataclasses

import numpy as np
from perch_core import so3
from perch_core.jit import compiled

from perch_perception.ukf import layout as at
from perch_perception.ukf.measurement import VioPose
from perch_perception.ukf.unscented import Belief, CovarianceError

_LEAST = 1e-12  # variance that is left of what VIO claims to know exactly


def join(belief: Belief, pose: VioPose) -> Belief:
    """Belief with VIO's velocity, and as sure of it.

    VIO's covariance C of the velocity is that in B, where the camera measures it: of the error beside what the attitude's makes of
    it in W, u = dv - A theta, A = -[v]x R. In its place above stands u. The pose is VIO's already and stays: Joseph's form with a gain
    of zero for it, which leaves the pose's own block as it was. Where C is larger than P_uu, by M, the velocity moves by
    P_uu (P_uu + M)^-1 of y, and M is added as an error of its own.

    Args:
        belief: with VIO's pose; predicted velocity.
        pose: its velocity and velocity's covariance must be given.

    Raises:
        CovarianceError: a covariance is not positive definite.
    """
    x = belief.x.copy()
    A = -so3.hat(x[at.VELOCITY]) @ so3.quat_to_matrix(x[at.QUATERNION])
    try:
        step, P = _joined(belief.P, A, np.ascontiguousarray(pose.velocity_covariance), pose.v_WB - x[at.VELOCITY])
    except np.linalg.LinAlgError:
        raise CovarianceError("covariance after an update is not positive definite") from None
    x[at.VELOCITY] += step[at.D_VELOCITY]
    x[at.GYRO_BIAS] += step[at.D_GYRO_BIAS]
    x[at.ACCEL_BIAS] += step[at.D_ACCEL_BIAS]
    return dataclasses.replace(belief, x=x, P=P)


@compiled
def _joined(P, A, C, y):
    """`join`'s step (21,) and covariance (21, 21), of P (21, 21), A and VIO's C (3, 3) and y (3,)."""
    n = len(P)
    beside, back, u = np.eye(n), np.eye(n), np.zeros((3, n))  # indices: `layout`
    beside[3:6, 6:9] = -A
    back[3:6, 6:9] = A
    u[:, 3:6] = np.eye(3)
    P = beside @ P @ beside.T
    own = u @ P @ u.T
    D, M = split(own, C)
    step = P @ u.T @ np.linalg.solve(own + M, y)
    G = np.linalg.solve(own, u @ P).T
    pose = G.copy()  # of position, attitude and drift
    pose[3:6] = 0.0
    pose[9:15] = 0.0
    P = back @ (P - G @ D @ G.T + pose @ D @ pose.T + u.T @ M @ u) @ back.T
    return step, 0.5 * (P + P.T)


@compiled
def split(own, C):
    """D and M, both >= 0, with own - D + M = C and D <= own: what C is smaller by in some directions, and larger in others, (n, n).

    The directions are those in which both are diagonal, own = L L^T, L^-1 C L^-T = E diag(l) E^T; the positive part of own - C in
    others may be larger than own.

    Raises:
        numpy.linalg.LinAlgError: `own` is not positive definite.
    """
    L = np.linalg.cholesky(own)
    half = np.linalg.solve(L, C + _LEAST * np.eye(len(C)))
    values, E = np.linalg.eigh(np.linalg.solve(L, half.T))
    F = L @ E
    return (F * np.maximum(1.0 - values, 0.0)) @ F.T, (F * np.maximum(values - 1.0, 0.0)) @ F.T
