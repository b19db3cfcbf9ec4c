"""VIO's whole state handed over: taken as it is, together with what hangs together in it, unless VIO has forgotten its biases."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_perception.ukf import Inertial, VioOutcome, handover
from perch_perception.ukf import layout as at
from perch_perception.ukf.odometry import vio_state

from unit.estimator_flight import MS, Flight


def whole_state(flight, k, rng, spread=0.003):
    """VIO's state at step k, with errors of the covariance that comes with it."""
    A = rng.normal(size=(15, 15)) * spread
    error = A @ rng.normal(size=15)
    t, r = flight.truth, flight.readings
    q = so3.quat_multiply(flight.q[k], so3.quat_exp(-error[6:9]))
    inertial = Inertial(r.gyro_bias[k] - error[9:12], r.accel_bias[k] - error[12:15], A @ A.T)
    return vio_state(k * 2 * MS, t.p_WB[k] - error[:3], q, t.v_WB[k] - error[3:6], inertial), error


def test_a_whole_state_is_taken_as_it_is():
    """Mean and covariance at its stamp, cross-covariances and biases included."""
    rng, flight = np.random.default_rng(1), Flight(3, latency=0.0).fly(end=300)
    pose, error = whole_state(flight, 299, rng)
    pose = replace(pose, inertial=replace(pose.inertial, P=pose.inertial.P + 1e-9 * np.eye(15)))
    flight.estimator._base = None  # as before the first pose
    assert flight.estimator.add_vio(pose) is VioOutcome.STARTED
    np.testing.assert_allclose(flight.error(), error, atol=1e-6)
    np.testing.assert_allclose(flight.estimator.estimate.P, pose.inertial.P, rtol=1e-6, atol=1e-12)


def test_the_drift_is_what_the_pose_is_wrong_by():
    """p + d is the pose itself: its variance is nothing, in the turned axes of the attitude as well."""
    pose, _ = whole_state(Flight(3), 2000, np.random.default_rng(2))  # far from level
    doubt = np.diag([1e-4, 2e-4, 3e-4, 1e-5, 2e-5, 3e-5])
    belief = handover.take_over(pose, doubt)
    H = np.zeros((6, 21))
    H[:3, at.D_POSITION], H[3:, at.D_ATTITUDE], H[:, at.D_DRIFT] = np.eye(3), so3.quat_to_matrix(pose.q_WB), np.eye(6)
    np.testing.assert_allclose(H @ belief.P @ H.T, np.zeros((6, 6)), atol=1e-9)
    np.testing.assert_allclose(belief.P[at.D_DRIFT, at.D_DRIFT], pose.covariance + doubt, atol=1e-9)
    assert np.linalg.eigvalsh(belief.P)[0] > 0


def test_a_state_that_knows_its_biases_worse_moves_pose_and_velocity_only():
    """As after a start in motion: what the filter has learned of the biases stays."""
    rng, flight = np.random.default_rng(4), Flight(5, latency=0.0).fly(end=1000)
    before = flight.estimator.estimate
    k = 999
    pose, _ = whole_state(flight, k, rng, 1e-3)
    P = pose.inertial.P.copy()
    P[9:, 9:] += np.diag([0.05**2] * 3 + [0.5**2] * 3)
    forgotten = replace(pose, inertial=Inertial(before.gyro_bias + 0.1, before.accel_bias + 1.0, P))
    assert flight.estimator.add_vio(forgotten).used
    after = flight.estimator.estimate
    assert np.abs(after.gyro_bias - before.gyro_bias).max() < 0.01 and np.abs(after.accel_bias - before.accel_bias).max() < 0.1
    np.testing.assert_allclose(after.p_WB, pose.p_WB, atol=2e-3)
    flight.assert_sane()


@pytest.mark.parametrize("spoil, outcome", [
    (lambda s: replace(s, gyro_bias=np.full(3, np.nan)), VioOutcome.NOT_FINITE),
    (lambda s: replace(s, P=s.P * np.nan), VioOutcome.NOT_FINITE),
    (lambda s: replace(s, P=-s.P), VioOutcome.BAD_COVARIANCE)])
def test_a_spoiled_state_is_refused(spoil, outcome):
    flight = Flight(5, latency=0.0).fly(end=1000)
    before = flight.estimator.estimate
    pose, _ = whole_state(flight, 999, np.random.default_rng(6))
    assert flight.estimator.add_vio(replace(pose, inertial=spoil(pose.inertial))) is outcome
    np.testing.assert_array_equal(flight.estimator.estimate.p_WB, before.p_WB)


def test_a_state_that_jumps_is_gated_like_a_pose():
    flight = Flight(5, latency=0.0).fly(end=1000)
    pose, _ = whole_state(flight, 999, np.random.default_rng(7), 1e-3)
    jumped = vio_state(pose.stamp, pose.p_WB + 1.0, pose.q_WB, pose.v_WB, pose.inertial)
    assert flight.estimator.add_vio(jumped) is VioOutcome.GATED
