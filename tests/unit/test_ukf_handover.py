"""VIO's whole state handed over: taken as it is, with all correlations in it."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_perception.ukf import Inertial, VioOutcome
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


def test_a_whole_state_takes_the_place_of_what_was_believed():
    """Also in flight, and whatever the filter believed of its biases: VIO has used the same samples."""
    rng, flight = np.random.default_rng(4), Flight(5, latency=0.0).fly(end=1000)
    pose, error = whole_state(flight, 999, rng, 1e-3)
    pose = replace(pose, inertial=replace(pose.inertial, P=pose.inertial.P + 1e-9 * np.eye(15)))
    assert flight.estimator.add_vio(pose) is VioOutcome.APPLIED
    np.testing.assert_allclose(flight.error(), error, atol=1e-6)
    np.testing.assert_allclose(flight.estimator.estimate.P, pose.inertial.P, rtol=1e-6, atol=1e-11)


def test_the_dimension_of_an_innovation_is_known():
    """The pose alone, or with the velocity."""
    flight = Flight(5, latency=0.0).fly(end=1000)
    assert flight.estimator.status.nis_dimension == 6
    flight.estimator.add_vio(whole_state(flight, 999, np.random.default_rng(4), 1e-3)[0])
    assert flight.estimator.status.nis_dimension == 9


def test_a_state_that_is_late_is_replayed_to_now():
    """The same state, 40 ms late: what it becomes by the same samples."""
    rng = np.random.default_rng(4)
    prompt, late = Flight(5, latency=0.0).fly(end=1000), Flight(5, latency=0.0).fly(end=1000)
    pose, _ = whole_state(prompt, 999, rng, 1e-3)
    prompt.estimator.add_vio(pose)
    for flight in (prompt, late):
        flight.poses = {}
        flight.fly(1000, 1020)
    late.estimator.add_vio(pose)
    np.testing.assert_allclose(late.error(), prompt.error(), atol=2e-4)
    np.testing.assert_allclose(np.diag(late.estimator.estimate.P), np.diag(prompt.estimator.estimate.P), rtol=0.05)


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
    jumped = vio_state(pose.stamp, pose.p_WB + 1.0, pose.q_WB, np.zeros(3), pose.inertial)
    assert flight.estimator.add_vio(jumped) is VioOutcome.GATED
