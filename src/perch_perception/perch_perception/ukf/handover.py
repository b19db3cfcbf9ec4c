"""VIO's whole inertial state in the place of this filter's belief.

VIO integrates the very IMU samples that this filter integrates, and sees images besides. Its state at an exposure is therefore this
filter's belief after a measurement more, and nothing that is made of both can be better than VIO's alone. With all 15 states and all
that hangs together in them there is nothing to be inferred: x := x_VIO, P := P_VIO. (From a pose and a velocity with a covariance
each, which is all that an Odometry message has room for, it must be: `drift`, `tracklet`. Then the heading and the gyro's bias,
and the climb's position and velocity, no longer hang together as they do: their whitened errors had variances of 2 and of 0.2.)

The drift is what VIO's next pose will be wrong by, should it be as wrong as this one: d = -(error of the pose).
"""

from __future__ import annotations

import numpy as np
from perch_core import so3

from perch_perception.ukf import layout as at
from perch_perception.ukf.measurement import VioPose
from perch_perception.ukf.unscented import Belief

_AS_SURE = 1.1      # ratio of variances up to which VIO knows its biases as well as this filter
_REGULAR = 1e-10    # variance [m^2, rad^2] of pose and drift together: they would be the same number


def knows_more(pose: VioPose, belief: Belief) -> bool:
    """Whether a pose comes with VIO's whole state, and VIO knows its biases as well as the belief does.

    It does not after a start in motion: what it had learned is lost then, and only its pose and velocity are news.
    """
    if pose.inertial is None:
        return False
    variance, own = np.diag(pose.inertial.P)[at.BIASES], np.diag(belief.P)[at.BIASES]
    return bool((variance <= _AS_SURE * own).all())


def take_over(pose: VioPose, doubt: np.ndarray) -> Belief:
    """VIO's state as belief.

    Args:
        pose: with the whole state.
        doubt: what VIO's map may be off beyond its covariance, (position, rotation in W), shape (6, 6).
    """
    x, P = np.zeros(at.NOMINAL_SIZE), np.zeros((at.ERROR_SIZE, at.ERROR_SIZE))
    x[at.POSITION], x[at.VELOCITY], x[at.QUATERNION] = pose.p_WB, pose.v_WB, pose.q_WB
    x[at.GYRO_BIAS], x[at.ACCEL_BIAS] = pose.inertial.gyro_bias, pose.inertial.accel_bias
    of_pose = np.zeros((6, at.VEHICLE_SIZE))  # (position, rotation in W) of the error
    of_pose[:3, at.D_POSITION], of_pose[3:, at.D_ATTITUDE] = np.eye(3), so3.quat_to_matrix(pose.q_WB)
    vehicle = slice(0, at.VEHICLE_SIZE)
    P[vehicle, vehicle] = pose.inertial.P + of_pose.T @ doubt @ of_pose
    P[at.D_DRIFT, vehicle] = -of_pose @ P[vehicle, vehicle]
    P[vehicle, at.D_DRIFT] = P[at.D_DRIFT, vehicle].T
    P[at.D_DRIFT, at.D_DRIFT] = -P[at.D_DRIFT, vehicle] @ of_pose.T + _REGULAR * np.eye(6)
    return Belief(pose.stamp, x, P)
