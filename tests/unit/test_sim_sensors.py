"""Sensors of the simulated vehicle: statistics of noise, camera times, calibration errors, seeds."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_sim import seeding
from perch_sim.camera_stream import CameraStream
from perch_sim.camera_timing import CameraTiming
from perch_sim.imu import Imu
from perch_sim.motors import MotorCommandError, Motors
from perch_sim.scenario import Wind, load_scenario
from perch_sim.state_history import StateHistory, TrueState, between
from perch_sim.wind import WindField

VEHICLE = load_vehicle("snapdragon")
MOUNT = VEHICLE.mounts["down"]
REST = np.array([0.0, 0.0, GRAVITY, 0.0, 0.0, 0.0])


def samples(config, count, inertial=REST, seed=1):
    imu = Imu(config, seeding.stream(seed, "imu"))
    return imu, np.array([np.concatenate(imu.sample(inertial)) for _ in range(count)])


def test_imu_at_rest_reads_plus_g_with_the_noise_of_its_file():
    imu, data = samples(VEHICLE.imu, 20_000)
    scatter = np.std(np.diff(data, axis=0), axis=0) / np.sqrt(2)  # differences are free of the bias
    np.testing.assert_allclose(scatter[:3], 0.316, rtol=0.03)
    np.testing.assert_allclose(scatter[3:], 0.01, rtol=0.03)
    assert np.all(np.abs(data.mean(axis=0) - REST) < np.repeat([0.2, 0.02], 3))
    assert abs(data[:, 2].mean() - GRAVITY) < 0.2


@pytest.mark.slow
def test_imu_biases_have_the_spread_of_the_file_and_walk():
    start = np.array([Imu(VEHICLE.imu, seeding.stream(seed, "imu")).bias for seed in range(400)])
    np.testing.assert_allclose(start.std(axis=0), np.repeat([0.05, 0.005], 3), rtol=0.15)
    moved = []
    for seed in range(200):
        imu, _ = samples(VEHICLE.imu, 250, seed=seed)
        moved.append(imu.bias - Imu(VEHICLE.imu, seeding.stream(seed, "imu")).bias)
    walk = np.sqrt(0.5) * np.repeat([0.002, 0.0002], 3)  # 250 samples are half a second
    np.testing.assert_allclose(np.std(moved, axis=0), walk, rtol=0.2)


def test_imu_saturates_at_its_range():
    _, data = samples(VEHICLE.imu, 50, inertial=np.array([400.0, -400.0, 0.0, 50.0, -50.0, 0.0]))
    assert np.all(data[:, [0, 1, 3, 4]] == [156.0, -156.0, 34.0, -34.0])


def test_switching_one_stream_off_leaves_the_others():
    a = seeding.stream(7, "imu").standard_normal(5)
    seeding.stream(7, "camera_down").standard_normal(1000)
    np.testing.assert_array_equal(seeding.stream(7, "imu").standard_normal(5), a)
    assert not np.any(seeding.stream(7, "wind").standard_normal(5) == a)
    assert not np.any(seeding.stream(8, "imu").standard_normal(5) == a)


def test_frames_keep_their_rate_and_arrive_after_read_out_and_transport():
    timing = CameraTiming(MOUNT, 3.5e-3, 0, seeding.stream(1, "timing"))
    frames = [timing.next() for _ in range(300)]
    middle = np.array([f.middle for f in frames]) * 1e-9
    assert np.diff(middle).mean() == pytest.approx(1 / 30, rel=1e-4)
    assert np.all(np.abs(np.diff(middle) - 1 / 30) < 4e-4)
    for f in frames:
        assert f.end - f.start == 3_500_000
        assert f.stamp - f.middle == -8_000_000  # stamp_offset of the file
        assert 9_300_000 + 5_000_000 <= f.arrival - f.end <= 9_300_000 + 10_000_000
    delays = np.array([f.arrival - f.end for f in frames]) * 1e-6
    assert delays.std() == pytest.approx(5 / np.sqrt(12), rel=0.1)


def test_an_exposure_has_the_displacement_of_a_moving_pad_at_each_of_its_poses():
    exposures, history, velocity = [], StateHistory(200), np.array([0.0, 2.0, -1.0])
    mount = VEHICLE.mounts["front"]
    for time in range(0, 100_000_001, 500_000):
        history.append(TrueState(time, np.array([1e-9 * time, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])))
    timing = CameraTiming(mount, 0.008, 30_000_000, np.random.default_rng(1))
    CameraStream(mount, timing, exposures.append, np.random.default_rng(2), velocity, 10_000_000).expose(100_000_000, history)
    poses, _, shifts = exposures[0]()
    times = np.array([p[0] for p, _ in poses])  # it flies at 1 m/s
    assert times[-1] - times[0] == pytest.approx(0.008, abs=1e-8)
    np.testing.assert_allclose(shifts, np.outer(times - 0.01, velocity), atol=1e-7)


def test_history_interpolates_a_turning_climb():
    """Against the closed form: constant acceleration and constant body rate."""
    history, w = StateHistory(100), np.array([0.0, 0.0, 4.0])
    def truth(t):
        return np.array([t, 0.5 * t * t, 0.0]), so3.quat_exp(w * t)

    for k in range(20):
        t = 0.002 * k
        history.append(TrueState(2_000_000 * k, np.concatenate([*truth(t), [1.0, t, 0.0], w])))
    for ns in (0, 1_234_567, 17_000_001, 38_000_000):
        p, q = truth(ns * 1e-9)
        found = history.at(ns)
        np.testing.assert_allclose(found.p_WB, p, atol=1e-12)
        assert abs(abs(found.q_WB @ q) - 1) < 1e-12
    times = (1_234_567, 4_000_000, 17_000_001)
    p_WB, q_WB = between([history.bracket(ns) for ns in times])  # an image must not depend on which of the two was asked
    np.testing.assert_array_equal(p_WB, [history.at(ns).p_WB for ns in times])
    np.testing.assert_array_equal(q_WB, [history.at(ns).q_WB for ns in times])
    with pytest.raises(LookupError, match="outside"):
        history.at(38_000_001)


@pytest.mark.slow
def test_gusts_have_the_strength_asked_for_and_drydens_memory():
    step, sigma = 0.05, 1.5
    field = WindField(Wind(steady=(0.0, 4.0, 0.0), gust_sigma=sigma), step, seeding.stream(1, "wind"))
    gusts = np.array([field.next() for _ in range(100_000)]) - [0.0, 4.0, 0.0]
    np.testing.assert_allclose(gusts.std(axis=0), sigma, rtol=0.05)
    # along the wind (y): exp(-V t / L); across (x): (1 - V t / 2L) exp(-V t / L), with L = 5 m
    lag = 10
    x = 4.0 * lag * step / 5.0
    def correlation(g):
        return np.mean(g[lag:] * g[:-lag]) / np.mean(g * g)

    assert correlation(gusts[:, 1]) == pytest.approx(np.exp(-x), abs=0.05)
    assert correlation(gusts[:, 0]) == pytest.approx((1 - x / 2) * np.exp(-x), abs=0.05)


def test_no_gusts_without_strength():
    field = WindField(Wind(steady=(1.0, 2.0, 3.0)), 0.002, seeding.stream(1, "wind"))
    np.testing.assert_array_equal(field.next(), [1.0, 2.0, 3.0])


def test_motors_limit_refuse_and_time_out():
    motors = Motors(500.0, 1700.0, timeout=100)
    assert np.all(motors.target(0) == 0.0)
    motors.command(0, True, np.array([0.0, 1000.0, 5000.0, 1700.0]))
    np.testing.assert_array_equal(motors.target(100), [500.0, 1000.0, 1700.0, 1700.0])
    with pytest.raises(MotorCommandError, match="nan"):
        motors.command(90, True, np.array([np.nan, 1000.0, 1000.0, 1000.0]))
    assert np.all(motors.target(101) == 0.0) and motors.timed_out  # the refused command kept nothing alive
    motors.command(120, True, np.full(4, 900.0))
    assert not motors.timed_out and np.all(motors.target(130) == 900.0)
    motors.command(140, False, np.full(4, 900.0))
    assert np.all(motors.target(141) == 0.0)


def test_an_imu_of_another_rate_is_refused_with_the_file_that_states_it(tmp_path):
    from perch_sim.simulation import Simulation

    file = tmp_path / "my quad.yaml"
    file.write_text("extends: snapdragon\nimu: {rate: 200.0}\n")
    with pytest.raises(ConfigError, match=f"^{re.escape(str(file))}: imu.rate: 200 is not the control rate of 500 Hz, the only one"):
        Simulation(dataclasses.replace(load_scenario("surface_90"), vehicle=str(file)), 1)
