"""The estimator under every fault of its inputs: what becomes of it, what it says, and that it heals."""

from dataclasses import replace

import numpy as np
import pytest
from perch_perception.ukf import Estimator, Health, ImuOutcome, ImuSample, VioOutcome, VioPose
from perch_perception.ukf.config import ImuNoise
from perch_perception.ukf.imu_buffer import ImuBuffer
from unit.estimator_flight import MS, Flight


def test_coasts_without_vio_grows_its_covariance_and_recovers():
    flight = Flight(7).fly(end=2300)
    before = flight.sigma()[:3].max()
    kept, flight.poses = flight.poses, {k: v for k, v in flight.poses.items() if not 2300 - 25 <= k < 2700}
    for k in range(2300, 2680):
        flight.step(k)
    assert flight.estimator.status.health is Health.COASTING
    assert flight.estimator.status.vio_age > 0.5  # longer than the kept IMU history
    coasting = flight.sigma()[:3].max()
    assert coasting > 1.5 * before
    assert np.abs(flight.error()[:3]).max() < 5 * coasting
    flight.poses = kept
    flight.fly(2680, 2900)
    assert flight.estimator.status.health is Health.RUNNING
    assert flight.sigma()[:3].max() < coasting
    flight.assert_sane()


@pytest.mark.parametrize(("change", "outcome"), [
    (lambda p, now: replace(p, stamp=now + 200 * MS), VioOutcome.FUTURE),
    (lambda p, now: replace(p, stamp=now + 10 * MS), VioOutcome.WAITING),
    (lambda p, now: replace(p, stamp=now - 2_000 * MS), VioOutcome.OUT_OF_ORDER),
    (lambda p, now: replace(p, p_WB=np.array([np.nan, 0, 0])), VioOutcome.NOT_FINITE),
    (lambda p, now: replace(p, q_WB=np.zeros(4)), VioOutcome.NOT_FINITE),
    (lambda p, now: replace(p, covariance=-np.eye(6)), VioOutcome.BAD_COVARIANCE),
    (lambda p, now: replace(p, p_WB=p.p_WB + [1.0, 0, 0]), VioOutcome.GATED),
])
def test_unusable_poses_are_refused_with_the_reason(change, outcome):
    flight = Flight(8).fly(end=1500)
    before = flight.estimator.estimate.p_WB.copy()
    pose = flight.poses[max(k for k in flight.poses if k < 1500)]
    now = 1499 * 2 * MS
    assert flight.estimator.add_vio(change(pose, now)) is outcome
    np.testing.assert_array_equal(flight.estimator.estimate.p_WB, before)
    if outcome is not VioOutcome.WAITING:
        assert outcome.value in flight.estimator.status.message
    flight.fly(1500, 1600)
    flight.assert_sane()


def test_a_pose_used_twice_is_a_duplicate():
    flight = Flight(9).fly(end=1500)
    used = flight.poses[max(k for k in flight.poses if k + 20 < 1500)]
    assert flight.estimator.add_vio(used) is VioOutcome.DUPLICATE


def test_a_pose_before_the_imu_has_come_is_refused():
    flight = Flight(9)
    assert flight.estimator.add_vio(flight.poses[160]) is VioOutcome.NO_IMU


def test_a_waiting_pose_is_applied_when_the_imu_gets_there():
    ahead, prompt = Flight(10, latency=-0.010), Flight(10, latency=0.0)
    ahead.fly(end=1500)
    prompt.fly(end=1500)
    assert ahead.estimator.status.accepted >= prompt.estimator.status.accepted - 1 > 50
    np.testing.assert_allclose(ahead.estimator.estimate.p_WB, prompt.estimator.estimate.p_WB, atol=2e-3)


def test_poses_that_come_faster_than_the_imu_and_before_it_are_all_used():
    """Motion capture at 240 Hz beside an IMU at 100 Hz."""
    estimator, pose = Estimator(), next(iter(Flight(10).poses.values()))
    told = 0
    for k in range(1, 300):
        now = k * 10 * MS
        while told * 4_166_667 < now + 3 * MS:
            estimator.add_vio(replace(pose, stamp=told * 4_166_667, p_WB=np.zeros(3), q_WB=np.array([0.0, 0.0, 0.0, 1.0]), inertial=None))
            told += 1
        estimator.add_imu(ImuSample(now, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
    assert estimator.status.health is Health.RUNNING and estimator.status.vio_age < 0.02


def test_a_jump_of_vios_map_is_gated_first_and_accepted_when_it_lasts():
    flight = Flight(11).fly(end=1500)
    flight.poses = {k: replace(p, p_WB=p.p_WB + [0.5, 0, 0]) if k >= 1480 else p for k, p in flight.poses.items()}
    flight.fly(1500, 1600)
    assert flight.estimator.status.rejected > 0
    assert np.abs(flight.error()[:3]).max() < 0.1  # the jump is not followed while it is gated
    flight.fly(1600, 2200)
    assert flight.estimator.status.health is Health.RUNNING
    np.testing.assert_allclose(flight.error()[:3], [-0.5, 0.0, 0.0], atol=0.06)  # VIO's map is the map
    flight.assert_sane()


@pytest.mark.parametrize(("make", "outcome"), [
    (lambda s: s._replace(w_B=(34.0, 0.0, 0.0)), ImuOutcome.SATURATED),
    (lambda s: s._replace(w_B=(24.5, 0.0, 24.5)), ImuOutcome.SATURATED),  # a sensor at 45 deg in the body
    (lambda s: s._replace(f_B=(0.0, 0.0, -156.0)), ImuOutcome.SATURATED),
])
def test_saturated_imu_samples_count_with_a_larger_covariance(make, outcome):
    good, bad = Flight(12).fly(end=1500), Flight(12).fly(end=1500)
    for k in range(1500, 1505):
        good.step(k)
        bad.step(k, imu=False)
        assert bad.estimator.add_imu(make(bad.sample(k))) is outcome
        assert outcome.value in bad.estimator.status.message
    bad.assert_sane()
    assert np.all(bad.sigma()[:9] >= 0.99 * good.sigma()[:9])
    assert bad.sigma()[3:9].max() > 1.2 * good.sigma()[3:9].max()
    bad.fly(1505, 2000)
    assert np.linalg.norm(bad.error()[:3]) < 0.15
    bad.assert_sane()


@pytest.mark.parametrize(("integration", "noisy"), [("mean", 1), ("instant", 2)])
def test_each_step_that_a_saturated_sample_is_part_of_is_noisy(integration, noisy):
    buffer = ImuBuffer(ImuNoise(integration=integration), 1.0)
    for k in range(20):
        buffer.add(ImuSample(k * 2 * MS, (0.0,) * 3, (0.0, 0.0, 156.0 if k == 10 else 9.81)))
    variance = buffer.run(0, 38 * MS)[:, 8]
    assert (variance > 1e4).sum() == noisy


def test_an_imu_gap_grows_the_covariance_and_heals():
    flight = Flight(13).fly(end=1500)
    before = flight.sigma()
    for k in range(1500, 1525):  # 50 ms
        flight.step(k, imu=False)
    flight.fly(1525, 1526)
    assert flight.imu_outcome is ImuOutcome.GAP
    assert np.all(flight.sigma()[3:9] > 1.5 * before[3:9])
    flight.fly(1526, 2000)
    assert np.linalg.norm(flight.error()[:3]) < 0.15
    flight.assert_sane()


@pytest.mark.parametrize(("make", "outcome"), [
    (lambda s: s._replace(w_B=(float("nan"), 0.0, 0.0)), ImuOutcome.NOT_FINITE),
    (lambda s: s._replace(f_B=(0.0, float("inf"), 0.0)), ImuOutcome.NOT_FINITE),
    (lambda s: s._replace(f_B=(0.0, 1e30, 0.0)), ImuOutcome.NOT_FINITE),
    (lambda s: s._replace(stamp=s.stamp - 20 * MS), ImuOutcome.NOT_NEWER),
])
def test_refused_imu_samples_leave_no_trace(make, outcome):
    """They may be another writer's, with the stamps of the good ones that come after them."""
    good, bad = Flight(12).fly(end=1500), Flight(12).fly(end=1500)
    for k in range(1500, 1600):
        assert bad.estimator.add_imu(make(bad.sample(k))) is outcome
        assert outcome.value in bad.estimator.status.message
        bad.step(k)
        good.step(k)
    np.testing.assert_array_equal(bad.estimator.estimate.p_WB, good.estimator.estimate.p_WB)
    np.testing.assert_array_equal(bad.estimator.estimate.P, good.estimator.estimate.P)


def test_a_first_sample_that_is_not_finite_is_refused():
    estimator = Estimator()
    assert estimator.add_imu(ImuSample(0, (float("nan"),) * 3, (0.0, 0.0, 9.81))) is ImuOutcome.NOT_FINITE
    assert estimator.estimate is None


def test_a_state_that_is_too_uncertain_says_so_before_what_came_last():
    estimator = Estimator()
    for k in range(10):
        estimator.add_imu(ImuSample(2 * MS * k, (0.0,) * 3, (0.0, 0.0, 9.81)))
    pose = VioPose(18 * MS, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.diag([1e6] * 3 + [1e-4] * 3))
    assert estimator.add_vio(pose) is VioOutcome.STARTED
    status = estimator.status
    assert status.health is Health.DIVERGED
    assert status.message == "1 sigma of 1000.0 m and 0.01 rad is too uncertain; VIO pose at 18000000 ns the filter started with it"


def test_a_covariance_that_breaks_is_counted_named_and_survived():
    flight = Flight(12).fly(end=1500)
    before = flight.estimator.status
    base = flight.estimator._base
    flight.estimator._anchors = [replace(base, P=-base.P)]
    pose = flight.poses[max(k for k in flight.poses if k < 1500)]
    assert flight.estimator.add_vio(pose) is VioOutcome.BROKEN
    status = flight.estimator.status
    assert (status.health, status.broken, status.rejected) == (Health.DIVERGED, before.broken + 1, before.rejected)
    assert "not positive definite" in status.message
    flight.fly(1500, 2000)
    assert flight.estimator.status.health is Health.RUNNING
    flight.assert_sane()
