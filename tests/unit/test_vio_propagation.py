"""The MSCKF's covariance in propagation, steps, clones, rest and starts, against finite differences and turned worlds."""

import copy
from collections.abc import Callable

import numpy as np
import pytest
from perch_core import so3
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_perception.ukf.config import ImuNoise
from perch_perception.vio import VioConfig, rest
from perch_perception.vio import state as at
from perch_perception.vio.motion_start import MotionStart
from perch_perception.vio.msckf import Msckf
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.propagation import propagate
from perch_perception.vio.start import KnownPose, at_rest, configured_pose, propagate_position
from perch_perception.vio.start_refinement import Refined

MOUNT = load_vehicle("snapdragon").mounts["down"]
WITHOUT_WALK = ImuNoise(gyro_bias_walk=0.0, accel_bias_walk=0.0)
N, STEP = at.INERTIAL_SIZE, 1e-5


def steps(count=30, gyro_noise=0.0, accel_noise=0.0):
    """IMU steps of a vehicle that tumbles; the noise is that of a reading."""
    rng = np.random.default_rng(1)
    w, f = rng.normal(0.0, 3.0, (count, 3)), rng.normal(0.0, 5.0, (count, 3)) + [0.0, 0.0, 9.0]
    return np.column_stack([np.full(count, 0.005), w, f, np.full(count, gyro_noise**2), np.full(count, accel_noise**2)])


def state(P=None, size=at.CORE_SIZE):
    rng = np.random.default_rng(2)
    A = rng.normal(size=(size, size))
    return at.State(0, so3.exp(rng.normal(size=3)), rng.normal(size=3), rng.normal(size=3), 0.1 * rng.normal(size=3), 0.3 * rng.normal(size=3),
                    MOUNT.R_BC.copy(), MOUNT.p_BC.copy(), 0.01, A @ A.T if P is None else P, rng.normal(size=3))


def moved(s, error):
    """A copy of a state to which an error of the inertial part, shape (15,), is added."""
    out = copy.deepcopy(s)
    out.R_WB, out.p_WB, out.v_WB = s.R_WB @ so3.exp(error[:3]), s.p_WB + error[3:6], s.v_WB + error[6:9]
    out.gyro_bias, out.accel_bias = s.gyro_bias + error[9:12], s.accel_bias + error[12:15]
    return out


def error(s, other):
    return np.concatenate([so3.log(s.R_WB.T @ other.R_WB), other.p_WB - s.p_WB, other.v_WB - s.v_WB,
                           other.gyro_bias - s.gyro_bias, other.accel_bias - s.accel_bias])


def derivative(function: Callable[[np.ndarray], np.ndarray], size=N):
    """Derivative by central differences of a function of `size` numbers at zero."""
    return np.column_stack([(function(STEP * e) - function(-STEP * e)) / (2.0 * STEP) for e in np.eye(size)])


def propagated(s, rows=None, imu=WITHOUT_WALK):
    out = copy.deepcopy(s)
    propagate(out, steps() if rows is None else rows, imu)
    return out


def test_the_covariance_is_propagated_by_the_derivative_of_the_motion():
    before = state()
    after, Phi = propagated(before), np.eye(at.CORE_SIZE)
    Phi[:N, :N] = derivative(lambda e: error(after, propagated(moved(before, e))))
    np.testing.assert_allclose(after.P, Phi @ before.P @ Phi.T, rtol=1e-4, atol=1e-4)


def test_the_noise_of_a_propagation_turns_with_the_world():
    rows, walk = steps(gyro_noise=0.5, accel_noise=0.5), ImuNoise(gyro_bias_walk=0.01, accel_bias_walk=0.02)
    s = state(np.zeros((at.CORE_SIZE, at.CORE_SIZE)))
    level = copy.deepcopy(s)
    level.R_WB = np.eye(3)
    turn = np.eye(at.CORE_SIZE)
    turn[at.POSITION, at.POSITION] = turn[at.VELOCITY, at.VELOCITY] = s.R_WB
    here, there = propagated(level, rows, walk).P, propagated(s, rows, walk).P
    np.testing.assert_allclose(there, turn @ here @ turn.T, atol=1e-12)
    pre = preintegrate(rows, s.gyro_bias, s.accel_bias)
    np.testing.assert_allclose(here[:9, :9], pre.Q, atol=1e-12)
    np.testing.assert_allclose(np.diag(here)[9:N], np.repeat([0.01**2, 0.02**2], 3) * pre.duration)


def test_the_time_offset_moves_a_clone_along_the_motion():
    """Its pose is that of stamp + time offset: with an error of the offset the pose is that of a little later."""
    s, h = state(np.zeros((at.CORE_SIZE, at.CORE_SIZE))), 1e-5
    s.P[at.TIME_OFFSET, at.TIME_OFFSET] = 4.0
    f = s.R_WB.T @ np.array([0.0, 0.0, GRAVITY]) + s.accel_bias  # the velocity stays
    later = propagated(s, np.array([[h, *(s.w_WB_B + s.gyro_bias), *f, 0.0, 0.0]]))
    s.add_clone(0)
    along = error(s, later)[:6] / h
    k = s.clone_at(0)
    np.testing.assert_allclose(s.P[k:k + 6, at.TIME_OFFSET], 4.0 * along, rtol=1e-6)
    np.testing.assert_allclose(s.P[k:k + 6, k:k + 6], 4.0 * np.outer(along, along), rtol=1e-6)


def test_a_step_moves_the_estimates_and_leaves_their_errors_as_seen_from_the_world():
    """R theta, dp + p x (R theta), dv + v x (R theta) and R_BC theta_c do not depend on the estimate."""
    s = state(size=at.CORE_SIZE + 2 * at.CLONE_SIZE)
    s.clones = [at.Clone(k, so3.exp([0.3, -0.2, 0.4 + k]), np.array([0.5, -k, 1.0])) for k in range(2)]

    def from_world():
        T = np.eye(s.size)
        T[at.THETA, at.THETA], T[at.CAMERA_ROTATION, at.CAMERA_ROTATION] = s.R_WB, s.R_BC
        T[at.POSITION, at.THETA], T[at.VELOCITY, at.THETA] = so3.hat(s.p_WB) @ s.R_WB, so3.hat(s.v_WB) @ s.R_WB
        for j, clone in enumerate(s.clones):
            k = s.clone_at(j)
            T[k:k + 3, k:k + 3], T[k + 3:k + 6, k:k + 3] = clone.R_WB, so3.hat(clone.p_WB) @ clone.R_WB
        return T @ s.P @ T.T

    old, before, dx = copy.deepcopy(s), from_world(), 0.3 * np.random.default_rng(3).normal(size=s.size)
    s.inject(dx)
    np.testing.assert_allclose(from_world(), before, atol=1e-9)
    np.testing.assert_allclose(error(old, s), dx[:N], atol=1e-12)
    np.testing.assert_allclose(so3.log(old.R_BC.T @ s.R_BC), dx[at.CAMERA_ROTATION], atol=1e-12)
    np.testing.assert_allclose(s.p_BC - old.p_BC, dx[at.CAMERA_POSITION])
    assert s.time_offset - old.time_offset == pytest.approx(dx[at.TIME_OFFSET])
    np.testing.assert_allclose(s.w_WB_B + s.gyro_bias, old.w_WB_B + old.gyro_bias)  # what the gyro has read
    for j, clone in enumerate(s.clones):
        k = s.clone_at(j)
        moved_by = np.concatenate([so3.log(old.clones[j].R_WB.T @ clone.R_WB), clone.p_WB - old.clones[j].p_WB])
        np.testing.assert_allclose(moved_by, dx[k:k + 6], atol=1e-12)


# -- rest and starts -----------------------------------------------------------------------------------------------------


def reading_at_rest(s):
    """Mean reading of an IMU at rest in a state: gyro, accelerometer, shape (6,)."""
    return np.concatenate([s.gyro_bias, s.accel_bias + s.R_WB.T @ [0.0, 0.0, GRAVITY]])


def test_the_update_at_rest_is_by_what_the_imu_reads_there():
    config, given = VioConfig(), []

    class Recorder(Msckf):
        def apply(self, columns, H, r, variance):
            given.append((columns, H, r, variance))
            return 0.0

    truth = state()
    estimate = moved(truth, -np.random.default_rng(4).normal(0.0, 1e-4, N))
    rows = np.tile([0.005, *reading_at_rest(truth), 1e-6, 1e-2], (40, 1))
    rest.hold(Recorder(config, copy.deepcopy(estimate), MOUNT.camera.fx), rows, 200_000_000, 2.0)
    (columns, H, r, variance), = given
    numeric = derivative(lambda e: reading_at_rest(moved(estimate, e)))
    np.testing.assert_allclose(H, numeric[:, columns], atol=1e-6)
    np.testing.assert_allclose(r, reading_at_rest(truth) - reading_at_rest(estimate), atol=1e-12)
    np.testing.assert_allclose(variance, np.repeat([config.imu.gyro_noise_density, config.imu.accel_noise_density], 3)**2 * 2.0 / 0.2)


def test_a_start_at_rest_is_sure_of_what_the_accelerometer_reads_and_of_nothing_more():
    config, R = VioConfig(), so3.exp(np.array([0.5, -0.4, 0.0]))
    rows = np.tile([0.005, 0.01, -0.02, 0.03, *(R.T @ [0.0, 0.0, GRAVITY]), 1e-12, 1e-12], (40, 1))
    s = at_rest(config, MOUNT, 0, rows, configured_pose(np.zeros(3), 0.3))
    np.testing.assert_allclose(reading_at_rest(s), rows[0, 1:7], atol=1e-6)
    H = derivative(lambda e: reading_at_rest(moved(s, e)))[3:]
    noise = config.imu.accel_noise_density**2 / 0.2
    assert np.linalg.eigvalsh(H @ s.P[:N, :N] @ H.T)[-1] < 1.01 * noise
    assert np.diag(s.P)[at.THETA].max() > (0.1 * config.imu.accel_bias_init / GRAVITY)**2


def test_a_velocity_in_W_has_the_errors_of_that_in_B_of_the_tilt_and_of_the_heading():
    """A start in motion knows tilt and velocity in B, and takes the heading from its known pose."""
    rng, R = np.random.default_rng(5), so3.exp(np.array([0.0, 0.0, 0.7])) @ so3.exp(np.array([0.3, -0.4, 0.0]))
    A, v_B, heading = 0.01 * rng.normal(size=(23, 23)), np.array([2.0, -1.0, 0.5]), 0.1
    found = Refined(R, v_B, np.zeros(3), np.zeros(3), MOUNT.R_BC, MOUNT.p_BC, 0.0, A @ A.T, 1.0, 1.0, 0.1, 1.0)
    pose = KnownPose(np.zeros(3), R, np.diag([1e-4, 1e-4, 1e-4, heading**2]))
    s = MotionStart(VioConfig(), MOUNT)._state(found, pose, 0)
    np.testing.assert_allclose(s.v_WB, R @ v_B)
    in_B = found.covariance[:6, :6].copy()  # of (theta, v_B)
    in_B[:3, :3] += heading**2 * np.outer(R[2], R[2])
    J = np.eye(6)
    J[3:] = derivative(lambda e: R @ so3.exp(e[:3]) @ (v_B + e[3:]), 6)
    which = np.r_[at.THETA, at.VELOCITY]
    np.testing.assert_allclose(s.P[np.ix_(which, which)], J @ in_B @ J.T, atol=1e-8)


def test_a_start_is_where_the_motion_since_its_known_position_has_brought_it():
    """Its covariance is by the derivatives of that place, and of the IMU's readings on the way."""
    rows, first = steps(), state()
    last = propagated(first)
    known = copy.deepcopy(last)
    known.p_WB, known.P = first.p_WB.copy(), first.P.copy()

    def began(s, rows):
        out = copy.deepcopy(s)
        propagate_position(out, preintegrate(rows, s.gyro_bias, s.accel_bias))
        return out

    found, F = began(known, rows), np.eye(at.CORE_SIZE)
    np.testing.assert_allclose(found.p_WB, last.p_WB, atol=1e-9)
    F[at.POSITION, :N] = derivative(lambda e: began(moved(known, e), rows).p_WB)
    np.testing.assert_allclose(found.P, F @ known.P @ F.T, rtol=1e-4, atol=1e-4)

    noisy, expected = steps(gyro_noise=0.1, accel_noise=0.5), np.zeros((3, 3))
    for k in range(len(rows)):
        def read(e, k=k):
            changed = rows.copy()
            changed[k, 1:7] += e
            return began(known, changed).p_WB
        by_reading = derivative(read, 6)
        expected += by_reading @ np.diag(np.repeat([0.1, 0.5], 3)**2) @ by_reading.T
    added = (began(known, noisy).P - found.P)[at.POSITION, at.POSITION]
    np.testing.assert_allclose(added, expected, atol=0.01 * np.abs(expected).max())
