"""A start in motion: as wrong as it says, and none where the motion does not tell."""

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.values import ImuSample
from perch_core.vehicle import load_vehicle
from unit.simulated_tracks import Tracks, Truth, bounds
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.vio import VioConfig
from perch_perception.vio import state as at
from perch_perception.vio.bearing import observe
from perch_perception.vio.motion_start import MotionStart
from perch_perception.vio.start import configured_pose

MOUNT = load_vehicle("snapdragon").mounts["down"]
RATE, FRAMES, NOISE = 200.0, 20.0, 0.3
SHIPPED = VioConfig()
# tracks as noisy as the generator's, and an IMU as it is shaken in flight (config/sensors/euroc.yaml)
CONFIG = dataclasses.replace(
    SHIPPED, imu=dataclasses.replace(SHIPPED.imu, accel_noise_density=1.6e-2, gyro_noise_density=1e-3, accel_bias_init=0.2),
    calibration=dataclasses.replace(SHIPPED.calibration, track=NOISE), filter=dataclasses.replace(SHIPPED.filter, slide_turn=0.0, slide_zoom=0.0))


def begin(name, seed, give_up=3.5):
    """The first state that frames and IMU of a motion give, biases and calibration wrong as declared; its error and when it came [s]."""
    rng = np.random.default_rng([20, seed])
    truth, c, imu = Truth(name, rng, RATE, 4.0), CONFIG.calibration, CONFIG.imu
    bias = np.concatenate([rng.normal(0.0, 0.1, 3), rng.normal(0.0, imu.accel_bias_init, 3)])
    h, n = 1.0 / RATE, len(truth.w_B)
    w = truth.w_B + bias[:3] + rng.normal(0.0, imu.gyro_noise_density / np.sqrt(h), (n, 3))
    f = truth.f_B + bias[3:] + rng.normal(0.0, imu.accel_noise_density / np.sqrt(h), (n, 3))
    buffer = ImuBuffer(imu, 8.0)
    for k in range(-1, n):
        buffer.add(ImuSample(round((k + 1) * h * 1e9), tuple(w[max(k, 0)]), tuple(f[max(k, 0)])))
    turn, shift, offset = rng.normal(0.0, c.rotation, 3), rng.normal(0.0, c.translation, 3), rng.normal(0.0, c.time_offset)
    camera, lens = MOUNT.camera, rng.normal(0.0, 1.0, 4) * [c.focal, c.focal, c.centre, c.centre]
    real = dataclasses.replace(MOUNT, R_BC=MOUNT.R_BC @ so3.exp(turn), p_BC=MOUNT.p_BC + shift, camera=dataclasses.replace(
        camera, fx=camera.fx * (1.0 + lens[0]), fy=camera.fy * (1.0 + lens[1]), cx=camera.cx + lens[2], cy=camera.cy + lens[3]))
    tracks = Tracks(rng, truth, real, lambda m: NOISE * rng.normal(size=(m, 2)))
    start = MotionStart(CONFIG, MOUNT)
    for frame in range(round(give_up * FRAMES)):
        t = 0.02 + frame / FRAMES
        ids, pixels = tracks(*truth.at(t + offset)[:2])
        start.add(frame, round(t * 1e9), ids, observe(camera, pixels))
        state = start.solve(buffer, lambda _: configured_pose(np.zeros(3), 0.0))
        if state is not None:
            R, _, v = truth.at(t)
            M = R @ state.R_WB.T  # the heading is not what a start tells
            A = so3.exp(np.array([0.0, 0.0, np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])]))
            error = np.concatenate([so3.log((A @ state.R_WB).T @ R), A.T @ v - state.v_WB, bias[:3] - state.gyro_bias, bias[3:] - state.accel_bias])
            return state, error, t
    return None


PARTS = {"velocity": (slice(3, 6), at.VELOCITY), "gyro bias": (slice(6, 9), at.GYRO_BIAS), "accelerometer bias": (slice(9, 12), at.ACCEL_BIAS)}


@pytest.mark.slow
def test_a_start_in_motion_is_as_wrong_as_it_says():
    ends = [begin("hand", seed) for seed in range(24)]
    low, high = bounds(len(ends), 3)
    for part, (own, where) in PARTS.items():
        assert low < np.mean([e[own] @ np.linalg.solve(s.P[where, where], e[own]) for s, e, _ in ends]) / 3.0 < high, part
    assert max(t for _, _, t in ends) < 0.7  # at the second trial, if not at the first


@pytest.mark.slow
def test_a_start_in_motion_waits_where_nothing_tells_the_scale():
    """0.3 m/s with 0.2 m/s^2: half a second of that is less than the accelerometer's bias and noise."""
    assert begin("slow", 0, give_up=0.65) is None
