"""Noise of the IMU as measured from its samples: what it is, what it changes, and that rest is judged by the sensor's own."""

import numpy as np
import pytest
from perch_core.values import ImuSample
from perch_perception.ukf.config import ImuNoise
from perch_perception.ukf.imu_buffer import ImuBuffer, MeasuredNoise
from perch_perception.ukf.stillness import is_at_rest, window

IMU = ImuNoise()


def buffer(accel, gyro, rate=500.0, until=1.0, force=lambda t: np.zeros(3), seed=1):
    """A buffer of samples with noise of 1 sigma `accel` [m/s^2] and `gyro` [rad/s] over gravity and a force."""
    rng, imu = np.random.default_rng(seed), ImuBuffer(IMU, 3.0)
    for k in range(round(until * rate)):
        f = rng.normal(0.0, accel, 3) + [0.0, 0.0, 9.81] + force(k / rate)
        imu.add(ImuSample(round(1e9 * k / rate), tuple(rng.normal(0.0, gyro, 3).tolist()), tuple(f.tolist())))
    return imu


@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0])
def test_white_noise_is_found_at_any_rate(rate):
    found, rng = [], np.random.default_rng(2)
    for _ in range(40):
        noise = MeasuredNoise(0.1 / np.sqrt(rate))
        for _ in range(round(1.5 * rate)):
            variance, _ = noise.add(tuple(rng.normal(0.0, 0.3, 3)), 1.0 / rate, False)
        found.append(variance)
    assert np.mean(found) == pytest.approx(0.09, rel=0.05)


def test_noise_is_found_behind_the_low_pass_filter_of_an_imu():
    """Noise of density 1 behind a first-order filter of 42 Hz, at 1 kHz: the filter does not change its density at low frequency."""
    rate, rng, found = 1000.0, np.random.default_rng(3), []
    for _ in range(40):
        noise, x = MeasuredNoise(0.1), np.zeros(3)
        for _ in range(round(1.5 * rate)):
            x += (1.0 - np.exp(-2.0 * np.pi * 42.0 / rate)) * (rng.normal(0.0, np.sqrt(rate), 3) - x)
            variance, _ = noise.add(tuple(x), 1.0 / rate, False)
        found.append(variance / rate)
    assert 0.15 < np.mean(found) < 1.0, "differences of single samples find 0.02"


@pytest.mark.parametrize("rate", [200.0, 500.0])
def test_a_motion_is_no_noise(rate):
    noise = MeasuredNoise(IMU.accel_noise_density)
    for k in range(round(1.5 * rate)):
        variance, declared = noise.add((5.0 * np.sin(9.0 * k / rate), 5.0 * np.cos(9.0 * k / rate), 9.81), 1.0 / rate, False)
    assert variance == pytest.approx(0.1 * declared), "the least that is believed"


def test_vibration_counts_in_the_filters_and_not_in_the_detection_of_rest():
    sensor = np.array([IMU.gyro_noise_density**2, IMU.accel_noise_density**2]) * 500.0
    quiet, shaken = buffer(0.2, 0.008), buffer(3.0, 0.1)
    end = quiet.newest.stamp
    for imu, accel, gyro in ((quiet, 0.2, 0.008), (shaken, 3.0, 0.1)):
        np.testing.assert_allclose(np.median(imu.run(end - 200_000_000, end)[:, 7:], axis=0), [gyro**2, accel**2], rtol=0.3)
    np.testing.assert_allclose(shaken.run(end - 10_000_000, end, sensor_noise=True)[1:-1, 7:], np.tile(sensor, (3, 1)))
    assert is_at_rest(window(quiet, end)) and not is_at_rest(window(shaken, end))


def test_samples_on_both_sides_of_a_gap_are_not_compared():
    imu = buffer(0.0, 0.0, until=2.0)
    last = imu.newest.stamp
    for k in range(4):
        imu.add(ImuSample(last + 100_000_000 + 2_000_000 * k, (1.0, 2.0, 3.0), (20.0, 0.0, 9.81)))
    assert imu.latest[8] == pytest.approx(0.1 * IMU.accel_noise_density**2 * 500.0)


def test_a_run_has_whole_steps_as_they_are_and_cuts_the_first_and_the_last():
    imu = ImuBuffer(ImuNoise(), 1.0)
    for k in range(6):
        imu.add(ImuSample(2_000_000 * k, (0.1 * k, 0.0, 0.0), (0.0, 0.0, 9.81)))
    whole, cut, within = imu.run(2_000_000, 10_000_000), imu.run(3_000_000, 9_500_000), imu.run(4_500_000, 5_000_000)
    assert np.array_equal(whole, np.array(imu._rows[1:]))
    np.testing.assert_allclose(cut[:, 0], [0.001, 0.002, 0.002, 0.0015], rtol=1e-12)
    for column in (7, 8):
        np.testing.assert_allclose(cut[:, column] / whole[:, column], [2.0, 1.0, 1.0, 4.0 / 3.0], rtol=1e-12)
        np.testing.assert_allclose(within[:, column] / whole[1, column], [4.0], rtol=1e-12)
    assert np.array_equal(cut[1:-1], whole[1:-1]) and np.array_equal(cut[:, 1:7], whole[:, 1:7])
