"""What the estimate's covariance becomes in nav_msgs/Odometry."""

import numpy as np
from oracles.unscented import plus
from perch_core import so3
from perch_perception.ukf import layout as at
from perch_perception.ukf.odometry import covariances


def test_pose_and_twist_spread_as_their_covariances_say():
    """Against states drawn about the estimate: position and rotation about W's axes, velocity and angular velocity in B."""
    rng, gyro_noise = np.random.default_rng(3), 2e-3
    x = np.zeros(at.NOMINAL_SIZE)
    x[at.VELOCITY], x[at.QUATERNION] = (1.5, -0.7, 0.4), so3.quat_exp(np.array([0.5, -0.9, 0.3]))
    A = rng.normal(0.0, 1e-3, (15, 15))
    errors = np.zeros((200_000, at.ERROR_SIZE))
    errors[:, :15] = rng.standard_normal((len(errors), 15)) @ A.T
    drawn = plus(x, errors)
    turn = so3.quat_log(so3.quat_multiply(drawn[:, at.QUATERNION], so3.quat_conjugate(x[at.QUATERNION])))
    v_B = so3.quat_rotate(so3.quat_conjugate(drawn[:, at.QUATERNION]), drawn[:, at.VELOCITY])
    w_B = gyro_noise * rng.standard_normal((len(errors), 3)) - drawn[:, at.GYRO_BIAS]
    pose, twist = covariances(so3.quat_to_matrix(x[at.QUATERNION]), x[at.VELOCITY], A @ A.T, gyro_noise)
    for said, seen in ((pose, np.cov(np.hstack([drawn[:, :3], turn]).T)), (twist, np.cov(np.hstack([v_B, w_B]).T))):
        sigma = np.sqrt(np.diag(seen))
        np.testing.assert_allclose(said / np.outer(sigma, sigma), seen / np.outer(sigma, sigma), atol=0.02)
