"""The UKF's transforms against independent forms: numpy, filterpy's UKF, a finite-difference EKF, exact motion."""

import json
import subprocess
import sys

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from perch_core import so3
from perch_core.vehicle import GRAVITY
from perch_eval.perch_motion import PerchMotion
from perch_perception.ukf import UkfConfig, VioNoise, VioPose, drift, kernels, start, tracklet
from perch_perception.ukf import layout as at
from perch_perception.ukf.unscented import Belief, CovarianceError, UnscentedTransform


def random_belief(rng, spread=0.01):
    A = rng.normal(size=(21, 21)) * spread
    x = rng.normal(size=22)
    x[at.QUATERNION] /= np.linalg.norm(x[at.QUATERNION])
    x[10:16] *= 0.02
    x[at.DRIFT] *= 0.01
    return Belief(0, x, A @ A.T + 1e-6 * np.eye(21))


def random_run(rng, m=17):
    return np.column_stack([np.full(m, 0.002), rng.normal(0, 3, (m, 3)), rng.normal(0, 4, (m, 3)) + [0, 0, 9.8],
                            np.full(m, 1e-4), np.full(m, 0.1)])


def test_the_kernels_share_gravity_with_the_vehicle():
    assert kernels._GRAVITY == GRAVITY


def test_plus_and_minus_are_inverse():
    rng = np.random.default_rng(1)
    x = random_belief(rng).x
    errors = rng.normal(0, 0.5, (40, 21))
    np.testing.assert_allclose(at.minus(at.plus(x, errors), x), errors, atol=1e-12)


def test_mean_propagation_follows_a_perch_to_a_millimetre():
    """Exact readings through take-off and a flip of more than 600 deg/s, as instantaneous samples averaged in pairs."""
    motion = PerchMotion()
    m = motion.sample(np.arange(0.0, motion.duration - 0.003, 0.002))
    assert np.degrees(np.linalg.norm(m.w_WB_B, axis=1)).max() > 600
    x = np.zeros(22)
    x[at.POSITION], x[at.VELOCITY], x[at.QUATERNION] = m.p_WB[0], m.v_WB[0], m.q_WB[0]
    for k in range(1, len(m.times)):
        w, f = 0.5 * (m.w_WB_B[k] + m.w_WB_B[k - 1]), 0.5 * (m.f_B[k] + m.f_B[k - 1])
        kernels.advance(x, *w, *f, 0.002)
    assert np.abs(x[at.POSITION] - m.p_WB[-1]).max() < 1e-3
    assert np.linalg.norm(so3.log(m.R_WB[-1].T @ so3.quat_to_matrix(x[at.QUATERNION]))) < np.radians(0.05)


def test_compiled_and_plain_kernels_agree():
    rng = np.random.default_rng(2)
    a = random_belief(rng).x
    b = a.copy()
    for row in random_run(rng, 50):
        kernels.advance(a, *row[1:7], row[0])
        kernels.advance.py_func(b, *row[1:7], row[0])
    np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_compiled_prediction_equals_the_vectorised_one():
    rng = np.random.default_rng(3)
    for config in (UkfConfig(), UkfConfig(alpha=0.3, kappa=0.0)):
        transform = UnscentedTransform(config)
        belief, run = random_belief(rng), random_run(rng)
        predicted = transform.predict(belief, run, 34)
        x, P = transform.predict_vectorised(belief.x, belief.P, run)
        np.testing.assert_allclose(predicted.x, x, atol=1e-11)
        np.testing.assert_allclose(predicted.P - transform.process_noise(run), P, atol=1e-11)


FLY = """
import sys, json, numpy as np
if sys.argv[1] == "plain":
    sys.modules["numba"] = None  # as on a machine without it
from perch_perception.ukf import Estimator, ImuSample, VioPose
from perch_core.jit import COMPILED
from perch_perception.vio.preintegration import preintegrate
assert COMPILED == (sys.argv[1] != "plain")
rng, estimator = np.random.default_rng(1), Estimator()
for k in range(300):
    estimator.add_imu(ImuSample(k * 2_000_000, tuple(rng.normal(0.2, 0.01, 3)), tuple(rng.normal(0, 0.3, 3) + [0, 0, 9.81])))
    if k > 150 and k % 17 == 0:
        estimator.add_vio(VioPose((k - 20) * 2_000_000, rng.normal(0, 0.001, 3), np.array([0, 0, 0, 1.0]), np.eye(6) * 1e-6))
e = estimator.estimate
rows = np.column_stack([np.full(15, 0.002), rng.normal(0, 3, (15, 3)), rng.normal(0, 9, (15, 3)), np.full((15, 2), 0.01)])
pre = preintegrate(rows, np.full(3, 0.01), np.full(3, 0.1))
print(json.dumps([*e.p_WB, *e.v_WB, *e.q_WB, *e.P.ravel(), *pre.dR.ravel(), *pre.dv, *pre.dp, *pre.J.ravel(), *pre.Q.ravel()]))
"""


def test_without_numba_everything_comes_out_the_same():
    def fly(how):
        out = subprocess.run([sys.executable, "-c", FLY, how], capture_output=True, text=True, check=True)
        return np.array(json.loads(out.stdout))

    np.testing.assert_allclose(fly("plain"), fly("compiled"), rtol=1e-7, atol=1e-11)


def test_prediction_is_that_of_a_linearised_filter_for_small_covariances():
    """P -> F P F^T with F by central differences of the mean propagation."""
    rng = np.random.default_rng(4)
    transform = UnscentedTransform(UkfConfig())
    belief, run = random_belief(rng, 1e-4), random_run(rng)

    def propagate(error):
        x = at.plus(belief.x, error)
        for row in run:
            kernels.advance(x, *row[1:7], row[0])
        return x

    centre, F, h = propagate(np.zeros(21)), np.zeros((21, 21)), 1e-5
    for i in range(21):
        e = np.zeros(21)
        e[i] = h
        F[:, i] = (at.minus(propagate(e), centre) - at.minus(propagate(-e), centre)) / (2 * h)
    expected = F @ belief.P @ F.T + transform.process_noise(run)
    actual = transform.predict(belief, run, 34).P
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((actual - expected) / scale).max() < 1e-4


def test_process_noise_is_the_spread_of_integrated_noise():
    """Monte-Carlo of IMU noise alone through the mean propagation."""
    rng = np.random.default_rng(5)
    transform, m = UnscentedTransform(UkfConfig()), 20
    run = np.tile([0.002, 0, 0, 0, 0, 0, GRAVITY, 0.01**2, 0.3**2], (m, 1))
    ends = []
    for _ in range(1500):
        x = np.zeros(22)
        x[9] = 1.0
        noise = np.column_stack([rng.normal(0, 0.01, (m, 3)), rng.normal(0, 0.3, (m, 3))])
        for row, n in zip(run, noise):
            kernels.advance(x, *(row[1:7] + n), row[0])
        ends.append(x)
    spread = at.minus(np.array(ends), np.array([0] * 9 + [1] + [0] * 12, float)).std(axis=0)[:9]
    expected = np.sqrt(np.diag(transform.process_noise(run)))[:9]
    np.testing.assert_allclose(spread, expected, rtol=0.1)


def test_update_equals_filterpys_on_the_error_state():
    """filterpy's own UKF, whose state is the 21-dimensional error, gives the same gain, covariance and correction."""
    rng = np.random.default_rng(6)
    config = UkfConfig()
    transform, belief = UnscentedTransform(config), random_belief(rng)
    truth = at.plus(belief.x, 0.01 * rng.normal(size=21))
    q_vio = so3.quat_multiply(so3.quat_exp(truth[19:22]), truth[at.QUATERNION])
    p_vio, R = truth[at.POSITION] + truth[16:19], np.diag([1e-5] * 3 + [1e-6] * 3)
    innovation = transform.innovate(belief, p_vio, q_vio, R)

    reference = so3.quat_multiply(so3.quat_exp(belief.x[19:22]), belief.x[at.QUATERNION])

    def measure(error):
        x = at.plus(belief.x, error)
        q = so3.quat_multiply(so3.quat_exp(x[19:22]), x[at.QUATERNION])
        return np.concatenate([x[:3] + x[16:19], so3.log(so3.quat_to_matrix(q) @ so3.quat_to_matrix(reference).T)])

    points = MerweScaledSigmaPoints(21, config.alpha, config.beta, config.kappa)
    oracle = UnscentedKalmanFilter(21, 6, 0.0, measure, lambda x, dt: x, points)
    oracle.P, oracle.R = belief.P.copy(), R
    oracle.sigmas_f = points.sigma_points(np.zeros(21), belief.P)
    oracle.update(np.concatenate([p_vio, so3.log(so3.quat_to_matrix(q_vio) @ so3.quat_to_matrix(reference).T)]))
    np.testing.assert_allclose(innovation.gain, oracle.K, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(innovation.gain @ innovation.residual, oracle.x, atol=1e-10)
    np.testing.assert_allclose(belief.P - innovation.gain @ innovation.S @ innovation.gain.T, oracle.P, atol=1e-12)


def test_an_update_moves_the_pose_towards_the_truth():
    rng = np.random.default_rng(7)
    transform, belief = UnscentedTransform(UkfConfig()), random_belief(rng)
    belief.P[at.D_DRIFT, :] = belief.P[:, at.D_DRIFT] = 0.0
    belief.P[at.D_DRIFT, at.D_DRIFT] = 1e-10 * np.eye(6)
    belief.x[at.DRIFT] = 0.0
    truth = at.plus(belief.x, np.r_[0.05, -0.03, 0.04, np.zeros(3), 0.1, -0.05, 0.08, np.zeros(12)])
    innovation = transform.innovate(belief, truth[:3], truth[at.QUATERNION], np.diag([1e-8] * 6))
    after = transform.correct(belief, innovation)
    residual = at.minus(truth, after.x)
    assert np.linalg.norm(residual[:3]) < 2e-3 and np.linalg.norm(residual[6:9]) < 2e-3
    assert np.linalg.eigvalsh(after.P)[0] > 0


def test_a_covariance_that_is_not_positive_is_refused():
    transform, belief = UnscentedTransform(UkfConfig()), random_belief(np.random.default_rng(8))
    belief.P[4, 4] = -1.0
    with pytest.raises(CovarianceError):
        transform.predict(belief, random_run(np.random.default_rng(9)), 34)
    with pytest.raises(CovarianceError):
        transform.innovate(belief, np.zeros(3), np.array([0, 0, 0, 1.0]), np.eye(6))


def test_drift_has_the_covariance_that_vio_reports():
    """Whatever VIO's covariance does, the modelled drift keeps it as its marginal."""
    rng, noise = np.random.default_rng(10), VioNoise(drift_position=1e-5, drift_attitude=1e-5)
    belief = random_belief(rng)
    C = np.diag([1e-4] * 6)
    belief.P[at.D_DRIFT, at.D_DRIFT] = C
    for _ in range(30):
        A = rng.normal(size=(6, 2)) * 0.003
        C_next = C + A @ A.T
        belief = drift.advance(belief, noise, drift.increment(noise, C, C_next, 1 / 30), 1 / 30)
        C = C_next
    np.testing.assert_allclose(belief.P[at.D_DRIFT, at.D_DRIFT], C, rtol=0.05, atol=1e-6)


def test_drift_step_stays_positive_when_vios_covariance_shrinks():
    noise = VioNoise()
    W = drift.increment(noise, np.diag([1e-2] * 6), np.diag([1e-4] * 6), 1 / 30)
    assert np.linalg.eigvalsh(W)[0] > 0


def test_a_correction_of_vios_is_expected_as_large_as_what_its_covariance_loses():
    """Its first sight after a blind take-off moves VIO by centimetres; a gate that expected the floor alone refused it for half a second."""
    W = drift.increment(VioNoise(), np.diag([1e-4] * 6), np.diag([1e-5] * 6), 1 / 30)
    assert (np.diag(W) > 0.9 * (1e-4 - 1e-5)).all()


def vio_pose(rng, size):
    A, B = rng.normal(size=(6, 6)) * size, rng.normal(size=(3, 3)) * size
    q = so3.quat_exp(rng.normal(0, 0.5, 3))
    return VioPose(0, rng.normal(0, 0.1, 3), q, A @ A.T, rng.normal(0, 0.1, 3), B @ B.T)


def beside_attitude(x):
    """Of the velocity in B, without what the attitude's error makes of it in W, (3, 21)."""
    U = np.zeros((3, 21))
    U[:, at.D_VELOCITY], U[:, at.D_ATTITUDE] = np.eye(3), so3.hat(x[at.VELOCITY]) @ so3.quat_to_matrix(x[at.QUATERNION])
    return U


@pytest.mark.parametrize("size", [1e-3, 0.3])
def test_pose_and_velocity_are_as_sure_as_vios(size):
    """Whether the filter was surer or more doubtful."""
    rng = np.random.default_rng(12)
    pose = vio_pose(rng, size)
    followed = drift.follow(random_belief(rng), pose, np.zeros((6, 6)))
    joined = tracklet.join(followed, pose)
    J = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), so3.quat_to_matrix(followed.x[at.QUATERNION])]])
    rows = np.r_[0:3, 6:9]
    for belief in (followed, joined):
        np.testing.assert_allclose(J @ belief.P[np.ix_(rows, rows)] @ J.T, pose.covariance, rtol=1e-3, atol=1e-5 * size**2)
        assert np.linalg.eigvalsh(belief.P)[0] > 0
    U = beside_attitude(followed.x)
    np.testing.assert_allclose(U @ joined.P @ U.T, pose.velocity_covariance, rtol=1e-3, atol=1e-5 * size**2)


def test_a_specific_force_stays_known_when_the_attitude_becomes_as_vague_as_vios():
    """b_a = B theta + c: what c is known to does not change with the pose, and the bias's mean goes with the attitude's."""
    rng = np.random.default_rng(14)
    belief, pose = random_belief(rng), vio_pose(rng, 0.03)
    theta, bias = at.D_ATTITUDE, at.D_ACCEL_BIAS
    B = belief.P[bias, theta] @ np.linalg.inv(belief.P[theta, theta])
    after = drift.follow(belief, pose, np.zeros((6, 6)))
    beside = np.zeros((3, 21))
    beside[:, bias], beside[:, theta] = np.eye(3), -B
    np.testing.assert_allclose(beside @ after.P @ beside.T, beside @ belief.P @ beside.T, rtol=1e-9, atol=1e-12)
    moved = at.minus(after.x, belief.x)
    np.testing.assert_allclose(moved[bias], B @ moved[theta], atol=1e-12)


def test_a_velocity_tells_the_biases_what_the_measurement_behind_it_would():
    """VIO measures the velocity itself and passes its estimate on: the filter ends where that measurement would have taken it."""
    rng = np.random.default_rng(15)
    belief = random_belief(rng)
    belief.x[at.VELOCITY] = 0.0  # so that the attitude's error makes nothing of it
    H = np.zeros((3, 21))
    H[:, at.D_VELOCITY] = np.eye(3)
    z, R = rng.normal(0, 0.01, 3), np.diag([1e-4, 4e-4, 9e-4])
    K = belief.P @ H.T @ np.linalg.inv(H @ belief.P @ H.T + R)
    P = belief.P - K @ H @ belief.P
    pose = VioPose(0, belief.x[:3], belief.x[at.QUATERNION], np.eye(6), (K @ z)[at.D_VELOCITY], P[3:6, 3:6])
    joined = tracklet.join(belief, pose)
    rows = np.r_[3:6, 9:15]
    np.testing.assert_allclose(at.minus(joined.x, belief.x)[rows], (K @ z)[rows], atol=1e-12)
    np.testing.assert_allclose(joined.P[np.ix_(rows, rows)], P[np.ix_(rows, rows)], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(joined.P[3:6, :], P[3:6, :], rtol=1e-6, atol=1e-12)


def test_an_echo_of_the_same_samples_tells_the_biases_nothing():
    """Blind, VIO's velocity is as sure as the filter's own prediction."""
    belief = random_belief(np.random.default_rng(16))
    U = beside_attitude(belief.x)
    pose = VioPose(0, belief.x[:3], belief.x[at.QUATERNION], np.eye(6), belief.x[at.VELOCITY].copy(), U @ belief.P @ U.T)
    joined = tracklet.join(belief, pose)
    np.testing.assert_allclose(joined.P, belief.P, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(joined.x, belief.x)


def test_at_rest_tilt_and_accelerometer_bias_are_one_unknown():
    """VIO's level is that of the same accelerometer: their sum, seen as a force, is known to the mean's noise."""
    config, rng, tilt = UkfConfig(), np.random.default_rng(13), 0.005
    q = so3.quat_exp(np.array([0.02, -0.01, 0.7]))
    up_B = so3.quat_to_matrix(q).T @ np.array([0.0, 0.0, GRAVITY])
    steps = np.column_stack([np.full(100, 0.002), np.zeros((100, 3)), up_B + rng.normal(0, 0.32, (100, 3)), np.full((100, 2), 0.01)])
    pose = VioPose(200_000_000, np.zeros(3), q, np.diag([1e-6] * 3 + [tilt**2] * 3), np.zeros(3), np.eye(3) * 1e-4)
    belief = start.from_vio(config, pose, steps)
    H = np.zeros((3, 21))
    H[:, at.D_ATTITUDE], H[:, at.D_ACCEL_BIAS] = so3.hat(up_B), np.eye(3)
    np.testing.assert_allclose(H @ belief.P @ H.T, np.eye(3) * config.imu.accel_noise**2 / 100, atol=1e-6)
    across = np.linalg.svd(so3.hat(up_B))[0][:, 0]
    own = across @ belief.P[at.D_ACCEL_BIAS, at.D_ACCEL_BIAS] @ across
    assert own > (tilt * GRAVITY) ** 2  # alone, the bias is as unknown as the tilt makes it
