"""A start in motion: as wrong as it says, and none where the motion does not tell."""

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.covariance import largest_sigma
from perch_core.values import ImuSample, InertialState, limits
from perch_core.vehicle import load_vehicle
from unit.simulated_tracks import Tracks, Truth, bounds
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.ukf.odometry import state_of
from perch_perception.vio import VioConfig
from perch_perception.vio import state as at
from perch_perception.vio.bearing import observe
from perch_perception.vio.last_pose import LastPose
from perch_perception.vio.motion_start import MotionStart
from perch_perception.vio.odometry import _estimate
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.start import POSE_ROWS, add_heading_by_bias, at_rest, configured_pose, initial_state

MOUNT = load_vehicle("snapdragon").mounts["down"]
RATE, FRAMES, NOISE = 200.0, 20.0, 0.3
SHIPPED = VioConfig()
# tracks as noisy as the generator's, and an IMU as it is shaken in flight (config/sensors/euroc.yaml)
CONFIG = dataclasses.replace(
    SHIPPED, imu=dataclasses.replace(SHIPPED.imu, accel_noise_density=1.6e-2, gyro_noise_density=1e-3, accel_bias_init=0.2),
    calibration=dataclasses.replace(SHIPPED.calibration, track=NOISE), filter=dataclasses.replace(SHIPPED.filter, slide_turn=0.0, slide_zoom=0.0))


def begin(name, seed, give_up=3.5, fps=FRAMES, gap=(0.0, 0.0)):
    """The first state that frames and IMU of a motion give, biases and calibration wrong as declared; its error and when it came [s].

    In the gap there are no samples of the IMU.
    """
    rng = np.random.default_rng([20, seed])
    truth, c, imu = Truth(name, rng, RATE, 4.0), CONFIG.calibration, CONFIG.imu
    bias = np.concatenate([rng.normal(0.0, 0.1, 3), rng.normal(0.0, imu.accel_bias_init, 3)])
    h, n = 1.0 / RATE, len(truth.w_B)
    w = truth.w_B + bias[:3] + rng.normal(0.0, imu.gyro_noise_density / np.sqrt(h), (n, 3))
    f = truth.f_B + bias[3:] + rng.normal(0.0, imu.accel_noise_density / np.sqrt(h), (n, 3))
    buffer = ImuBuffer(imu, 8.0)
    for k in range(-1, n):
        if gap[0] < k * h < gap[1]:
            continue
        buffer.add(ImuSample(round((k + 1) * h * 1e9), tuple(w[max(k, 0)]), tuple(f[max(k, 0)])))
    turn, shift, offset = rng.normal(0.0, c.rotation, 3), rng.normal(0.0, c.translation, 3), rng.normal(0.0, c.time_offset)
    camera, lens = MOUNT.camera, rng.normal(0.0, 1.0, 4) * [c.focal, c.focal, c.centre, c.centre]
    real = dataclasses.replace(MOUNT, R_BC=MOUNT.R_BC @ so3.exp(turn), p_BC=MOUNT.p_BC + shift, camera=dataclasses.replace(
        camera, fx=camera.fx * (1.0 + lens[0]), fy=camera.fy * (1.0 + lens[1]), cx=camera.cx + lens[2], cy=camera.cy + lens[3]))
    tracks = Tracks(rng, truth, real, lambda m: NOISE * rng.normal(size=(m, 2)))
    start = MotionStart(CONFIG, MOUNT)
    for frame in range(round(give_up * fps)):
        t = 0.02 + frame / fps
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
    ends = [begin("hand", seed) for seed in range(14)]
    low, high = bounds(len(ends), 3)
    for part, (own, where) in PARTS.items():
        assert low < np.mean([e[own] @ np.linalg.solve(s.P[where, where], e[own]) for s, e, _ in ends]) / 3.0 < high, part
    assert max(t for _, _, t in ends) < 0.7  # at the second trial, if not at the first


def test_a_start_in_motion_over_a_gap_in_the_imu():
    state, error, _ = begin("hand", 0, fps=10.0, gap=(0.2, 0.9))
    assert (np.abs(error[3:6]) < 4.0 * np.sqrt(np.diag(state.P)[at.VELOCITY])).all()


@pytest.mark.slow
def test_a_start_in_motion_waits_where_nothing_tells_the_scale():
    """0.3 m/s with 0.2 m/s^2: half a second of that is less than the accelerometer's bias and noise."""
    assert begin("slow", 0, give_up=0.65) is None


def test_a_heading_that_the_gyro_has_propagated_has_the_errors_of_its_bias_and_noise():
    """The derivative by finite differences; the sigma after ten seconds of a bias that is known to 5 mrad/s."""
    rng, h, seconds = np.random.default_rng(4), 1.0 / RATE, 10.0
    w = np.array([0.3, -0.2, 0.1]) + rng.normal(0.0, 0.2, (round(seconds * RATE), 3))
    rows = np.column_stack([np.full(len(w), h), w, np.tile([0.0, 0.0, 9.81, 1e-6, 0.1], (len(w), 1))])
    R, known = so3.exp(np.array([0.1, 0.2, 0.3])), configured_pose(np.zeros(3), 0.0)
    part = preintegrate(rows, np.zeros(3), np.zeros(3))
    pose = known.turned(R @ part.dR, part.J[:3, :3], part.Q[:3, :3])
    for axis in np.eye(3):
        step = so3.log((R @ part.dR).T @ R @ preintegrate(rows, 1e-5 * axis, np.zeros(3)).dR) / 1e-5
        assert (R @ part.dR @ step)[2] == pytest.approx(pose.heading_by_bias @ axis, abs=1e-3 * seconds)
    assert pose.covariance[3, 3] - known.covariance[3, 3] == pytest.approx(1e-6 * h**2 * len(w), rel=0.01)
    state = initial_state(CONFIG, MOUNT, 0, pose.R_WB, pose, np.zeros(3), np.zeros(3), 0.0, 0.1, 5e-3)
    before = state.P.copy()
    add_heading_by_bias(state, pose)
    up_B, u = pose.R_WB[2], pose.heading_by_bias
    assert up_B @ (state.P - before)[at.THETA, at.THETA] @ up_B == pytest.approx(25e-6 * u @ u) and u @ u > 20.0
    np.testing.assert_allclose(state.P[at.THETA, at.GYRO_BIAS], 25e-6 * np.outer(up_B, u))


@pytest.mark.parametrize("losses", [1, 200])
def test_a_start_after_losses_of_any_length_is_accepted_by_those_who_receive_it(losses):
    """A vehicle that was fast for 1000 s without a filter may be anywhere: its sigma grows to 1 km and no further."""
    imu, last = ImuBuffer(CONFIG.imu, 2.5), LastPose(configured_pose(np.zeros(3), 0.0))
    for loss in range(losses):
        now = (loss + 1) * 1_000_000_000_000
        imu.add(ImuSample(now, (0.0,) * 3, (0.0, 0.0, 9.81)))
        last.known_at = now - 1_000_000_000_000, 25.0
        state = initial_state(CONFIG, MOUNT, now, np.eye(3), last.pose, np.zeros(3), np.zeros(3), 0.01, 0.1, 5e-3)
        last.propagate_position(state, imu)
        assert largest_sigma(state.P[at.POSITION, at.POSITION]) == pytest.approx(1000.0)
        last.pose = dataclasses.replace(last.pose, covariance=_estimate(state).pose_covariance[POSE_ROWS])
    e = _estimate(state)
    value = InertialState(e.stamp, e.p_WB, so3.quat_from_matrix(e.R_WB), e.v_WB, e.gyro_bias, e.accel_bias, e.P, "odom")
    assert limits.problem(value) == "" and state_of(value).problem() is None


def test_starts_take_over_the_heading_with_the_error_of_its_bias():
    steps = np.tile([1.0 / RATE, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 1e-6, 1e-2], (60, 1))
    known = configured_pose(np.zeros(3), 0.0)
    still, turned = (at_rest(CONFIG, MOUNT, 0, steps, pose) for pose in (known, known.turned(np.eye(3), -5.0 * np.eye(3), np.zeros((3, 3)))))
    variance = still.P[at.GYRO_BIAS, at.GYRO_BIAS][2, 2]
    assert (turned.P - still.P)[at.THETA, at.THETA][2, 2] == pytest.approx(25.0 * variance, rel=1e-6)
    assert turned.P[at.THETA, at.GYRO_BIAS][2, 2] == pytest.approx(-5.0 * variance, rel=1e-6)
