"""The estimator as a whole: accuracy, delay, consistency."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_eval import consistency
from perch_perception.ukf import Estimator, Health, UkfConfig, VioPose
from perch_perception.ukf.config import VioNoise
from scipy.linalg import block_diag
from unit.estimator_flight import DT, IMU, WHITE, Flight


def relative_rmse(latency, seeds=4):
    """Position RMSE against VIO's own (drifting) map in the perch: what delay compensation can influence."""
    squares = []
    for seed in range(seeds):
        flight = Flight(seed, latency=latency).fly(end=2400)
        for k in range(2400, len(flight.truth.times)):
            flight.step(k)
            squares.append(flight.error()[:3] ** 2)
    return np.sqrt(np.mean(squares))


def test_before_vio_there_is_a_status_but_no_estimate():
    flight = Flight().fly(end=150)
    status = flight.estimator.status
    assert flight.estimator.estimate is None
    assert status.health is Health.INITIALISING
    assert np.isinf([status.vio_age, status.position_sigma, status.attitude_sigma]).all()


def test_starts_at_rest_with_the_gyro_bias():
    flight = Flight(3).fly(end=400)
    assert flight.estimator.status.health is Health.RUNNING
    assert np.abs(flight.error()[9:12]).max() < 4 * IMU.gyro_noise / 10
    assert np.abs(flight.error()[3:6]).max() < 0.05


def test_the_motion_is_that_of_the_estimate_to_the_last_bit():
    flight = Flight(3)
    assert flight.estimator.motion is None
    e = flight.fly(end=400).estimator.estimate
    assert flight.estimator.motion == (*e.p_WB, *e.v_WB, *e.q_WB, *e.w_WB_B)


def test_starts_in_motion_from_vios_pose_and_velocity():
    flight = Flight(4)
    flight.poses = {k: v for k, v in flight.poses.items() if k > 2000}  # VIO comes up in mid-flight
    flight.fly(end=2400)
    assert flight.estimator.status.health is Health.RUNNING
    assert np.linalg.norm(flight.error()[:3]) < 0.15
    assert np.linalg.norm(flight.error()[3:6]) < 0.15


@pytest.mark.slow
def test_tracks_a_perch_within_vios_own_drift():
    flight = Flight(5).fly(end=2400)
    errors = []
    for k in range(2400, len(flight.truth.times)):
        flight.step(k)
        errors.append(flight.error())
    errors = np.array(errors)
    assert np.sqrt((errors[:, :3] ** 2).mean(axis=0)).max() < 0.07
    assert np.sqrt((errors[:, 3:6] ** 2).mean(axis=0)).max() < 0.06
    assert np.degrees(np.abs(errors[-1, 6:9]).max()) < 2.0


def test_it_follows_vio_wherever_vio_drifts():
    """VIO's map is the map: the filter smooths VIO's noise and must not be further from VIO than that."""
    flight, off, own = Flight(6, latency=0.0), [], []
    for k in range(len(flight.truth.times)):
        flight.step(k)
        if k > 600 and k in flight.poses:
            off.append(flight.estimator.estimate.p_WB - flight.poses[k].p_WB)
            own.append(flight.truth.p_WB[k] - flight.poses[k].p_WB)
    assert np.linalg.norm(own, axis=1).max() > 0.02           # VIO drifts by centimetres
    assert np.sqrt(np.mean(np.square(off))) < 5.0 * WHITE[0]  # and the filter with it


def test_a_velocity_counts_as_much_as_its_covariance_says():
    """One that is well known is taken, one that is hardly known changes nothing."""
    errors = {}
    for sigma in (0.003, 3.0):
        flight = Flight(7, latency=0.0).fly(end=1200)
        k = min(k for k in flight.poses if k >= 1200)
        wrong = flight.truth.v_WB[k] + [0.03, 0.0, 0.0]
        v_B = so3.quat_to_matrix(flight.q[k]).T @ wrong
        flight.poses[k] = replace(flight.poses[k], v_B=v_B, velocity_covariance=np.eye(3) * sigma**2)
        flight.fly(start=1200, end=k + 1)
        errors[sigma] = np.abs(flight.estimator.estimate.v_WB - wrong).max()
        flight.assert_sane()
    assert errors[0.003] < 0.01 < 0.015 < errors[3.0]


def test_the_noise_of_pose_and_velocity_is_that_of_vio_and_what_is_added(monkeypatch):
    estimator, used = Estimator(UkfConfig(vio=VioNoise(position=0.1, attitude=0.2))), []
    monkeypatch.setattr(estimator._transform, "innovate", lambda prior, pose, R: used.append(R))
    pose = VioPose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.full((6, 6), 1.0), np.zeros(3), np.full((3, 3), 2.0))
    for measured in (pose, replace(pose, velocity_covariance=None)):
        estimator._innovate(None, measured)
    expected = np.full((6, 6), 1.0) + np.diag([0.01] * 3 + [0.04] * 3)
    np.testing.assert_allclose(used[0], block_diag(expected, np.full((3, 3), 2.0)))
    np.testing.assert_allclose(used[1], expected)


@pytest.mark.slow
def test_forty_milliseconds_of_delay_cost_less_than_a_fifth():
    prompt, late = relative_rmse(0.0), relative_rmse(0.040)
    assert late < 1.2 * prompt


@pytest.mark.slow
def test_nees_lies_within_its_bounds_where_vios_errors_are_white():
    """14 runs with errors that are new in every pose, as the filter assumes: averages inside 95 % bounds for most of the time."""
    samples, times = [], None
    for seed in range(14):
        flight, run, when = Flight(seed + 50, drift=False).fly(end=300), [], []
        for k in range(300, len(flight.truth.times)):
            flight.step(k)
            if k % 25 == 0:
                run.append(consistency.nees(flight.error()[:9], flight.estimator.estimate.P[:9, :9]))
                when.append(k * DT)
        samples.append(run)
        times = np.array(when)
    result = consistency.judge("pose and velocity", times, np.array(samples), 9)
    assert result.above <= 0.1
    assert result.mean.mean() > 0.6 * 9  # not hidden behind an inflated covariance


@pytest.mark.slow
def test_same_inputs_give_the_same_bits():
    a, b = Flight(6).fly(), Flight(6).fly()
    assert a.estimator.estimate.p_WB.tobytes() == b.estimator.estimate.p_WB.tobytes()
    assert a.estimator.estimate.P.tobytes() == b.estimator.estimate.P.tobytes()
