"""What is declared of the sensors is not what they are: scales of their own in every flight, heavy tails, and the same seed the same sensors."""

import numpy as np
import pytest

from perch_core import so3
from perch_core.vehicle import load_vehicle
from perch_sim.calibration import ATTITUDE_ERROR, CENTRE_ERROR, FOCAL_ERROR, SPREAD, TIME_ERROR, true_imu, true_mounts
from perch_sim.scenario import Scenario

VEHICLE = load_vehicle("snapdragon")
SEEDS = range(600)


def _errors() -> np.ndarray:
    """Over their declared sigmas, shape (flights, 8)."""
    out = []
    nominal = VEHICLE.mounts["down"]
    for seed in SEEDS:
        true = true_mounts(Scenario(name="test"), VEHICLE.mounts, seed)["down"]
        turn = so3.log(nominal.R_BC.T @ true.R_BC) / (ATTITUDE_ERROR / np.sqrt(3))
        out.append([(true.camera.fx / nominal.camera.fx - 1) / FOCAL_ERROR, (true.camera.fy / nominal.camera.fy - 1) / FOCAL_ERROR,
                    (true.camera.cx - nominal.camera.cx) / CENTRE_ERROR, (true.camera.cy - nominal.camera.cy) / CENTRE_ERROR,
                    *turn, (true.stamp_offset - nominal.stamp_offset) / TIME_ERROR])
    return np.array(out)


@pytest.mark.slow
def test_calibration_errors_have_the_declared_size_and_heavier_tails_than_a_normal_distribution():
    errors = _errors()
    # A scale that is log-uniform between 1/1.5 and 1.5 has a mean square of 1.11.
    np.testing.assert_allclose(np.sqrt((errors**2).mean(axis=0)), np.sqrt(1.11), rtol=0.15)
    assert (np.abs(errors) > 3.0).mean() > 2 * 0.0027
    assert np.abs(errors).max() <= 4.0 * SPREAD + 1e-6


def test_noise_and_biases_of_the_imu_are_up_to_half_as_large_again():
    names = ("accel_noise", "gyro_noise", "accel_bias_walk", "gyro_bias_walk", "accel_bias_init", "gyro_bias_init")
    ratios = np.array([[getattr(true_imu(VEHICLE.imu, seed), name) / getattr(VEHICLE.imu, name) for name in names] for seed in SEEDS])
    assert ratios.min() > 1 / SPREAD and ratios.max() < SPREAD
    assert (ratios.min(axis=0) < 0.7).all() and (ratios.max(axis=0) > 1.45).all()
    assert np.abs(np.corrcoef(ratios.T) - np.eye(6)).max() < 0.2, "each has its own"
    assert true_imu(VEHICLE.imu, 7) == true_imu(VEHICLE.imu, 7)


def test_the_cameras_of_an_ideal_scenario_are_as_calibrated():
    assert true_mounts(Scenario(name="test", realism="ideal"), VEHICLE.mounts, 1) == VEHICLE.mounts
