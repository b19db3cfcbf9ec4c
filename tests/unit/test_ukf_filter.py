"""The UKF's transforms against independent forms: numpy, filterpy's UKF, a finite-difference EKF, exact motion."""

import json
import subprocess
import sys

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from perch_core import so3
from perch_core.vehicle import GRAVITY
from open_loop.motion import PerchMotion
from oracles import unscented as oracle
from perch_perception.ukf import UkfConfig, VioPose, kernels, start, unscented, update_kernels
from perch_perception.ukf import layout as at
from perch_perception.ukf.unscented import Belief, CovarianceError, UnscentedTransform


def random_belief(rng, spread=0.01):
    A = rng.normal(size=(15, 15)) * spread
    x = rng.normal(size=16)
    x[at.QUATERNION] /= np.linalg.norm(x[at.QUATERNION])
    x[10:16] *= 0.02
    return Belief(0, x, A @ A.T + 1e-6 * np.eye(15))


def random_run(rng, m=17):
    return np.column_stack([np.full(m, 0.002), rng.normal(0, 3, (m, 3)), rng.normal(0, 4, (m, 3)) + [0, 0, 9.8],
                            np.full(m, 1e-4), np.full(m, 0.1)])


def process_noise(run):
    Q, imu = np.zeros((15, 15)), UkfConfig().imu
    update_kernels.add_process_noise(run, imu.gyro_bias_walk**2, imu.accel_bias_walk**2, Q)
    return Q


def test_plus_and_minus_are_inverse():
    rng = np.random.default_rng(1)
    x = random_belief(rng).x
    errors = rng.normal(0, 0.5, (40, 15))
    np.testing.assert_allclose(oracle.minus(oracle.plus(x, errors), x), errors, atol=1e-12)


def test_mean_propagation_follows_a_perch_to_a_millimetre():
    """Exact readings through take-off and a flip of more than 600 deg/s, as instantaneous samples averaged in pairs."""
    motion = PerchMotion()
    m = motion.sample(np.arange(0.0, motion.duration - 0.003, 0.002))
    assert np.degrees(np.linalg.norm(m.w_WB_B, axis=1)).max() > 600
    x = np.zeros(16)
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


def test_compiled_prediction_equals_the_vectorised_one(monkeypatch):
    rng = np.random.default_rng(3)
    for alpha in (unscented.ALPHA, 0.3):
        monkeypatch.setattr(unscented, "ALPHA", alpha)
        transform = UnscentedTransform(UkfConfig())
        belief, run = random_belief(rng), random_run(rng)
        predicted = transform.predict(belief, run, 34)
        x, P = oracle.predicted(transform, belief.x, belief.P, run)
        np.testing.assert_allclose(predicted.x, x, atol=1e-11)
        np.testing.assert_allclose(predicted.P - process_noise(run), P, atol=1e-11)


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
        x = oracle.plus(belief.x, error)
        for row in run:
            kernels.advance(x, *row[1:7], row[0])
        return x

    centre, F, h = propagate(np.zeros(15)), np.zeros((15, 15)), 1e-5
    for i in range(15):
        e = np.zeros(15)
        e[i] = h
        F[:, i] = (oracle.minus(propagate(e), centre) - oracle.minus(propagate(-e), centre)) / (2 * h)
    expected = F @ belief.P @ F.T + process_noise(run)
    actual = transform.predict(belief, run, 34).P
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((actual - expected) / scale).max() < 1e-4


def test_process_noise_is_the_spread_of_integrated_noise():
    """Monte-Carlo of IMU noise alone through the mean propagation."""
    rng = np.random.default_rng(5)
    m = 20
    run = np.tile([0.002, 0, 0, 0, 0, 0, GRAVITY, 0.01**2, 0.3**2], (m, 1))
    ends = []
    for _ in range(1500):
        x = np.zeros(16)
        x[9] = 1.0
        noise = np.column_stack([rng.normal(0, 0.01, (m, 3)), rng.normal(0, 0.3, (m, 3))])
        for row, n in zip(run, noise):
            kernels.advance(x, *(row[1:7] + n), row[0])
        ends.append(x)
    spread = oracle.minus(np.array(ends), np.array([0] * 9 + [1] + [0] * 6, float)).std(axis=0)[:9]
    expected = np.sqrt(np.diag(process_noise(run)))[:9]
    np.testing.assert_allclose(spread, expected, rtol=0.1)


def test_a_correction_carries_its_covariance_to_the_corrected_state():
    """An error e of the state before is minus(plus(x, step + e), plus(x, step)) of the one after; its derivative by differences."""
    rng = np.random.default_rng(7)
    belief, gain, S = random_belief(rng), 0.3 * rng.normal(size=(15, 6)), 1e-3 * np.eye(6)
    residual = rng.normal(size=6)
    corrected = UnscentedTransform.correct(belief, unscented.Innovation(residual, S, gain, 0.0))
    step = gain @ residual
    assert 0.3 < np.linalg.norm(step[at.D_ATTITUDE]) < 2.0
    np.testing.assert_allclose(oracle.minus(corrected.x, belief.x), step, atol=1e-12)
    h, J = 1e-6, np.zeros((15, 15))
    for i, e in enumerate(h * np.eye(15)):
        J[:, i] = (oracle.minus(oracle.plus(belief.x, step + e), corrected.x) - oracle.minus(oracle.plus(belief.x, step - e), corrected.x)) / (2.0 * h)
    np.testing.assert_allclose(corrected.P, J @ (belief.P - gain @ S @ gain.T) @ J.T, atol=1e-8)


@pytest.mark.parametrize("size", [6, 9])
def test_update_equals_filterpys_on_the_error_state(size):
    """filterpy's own UKF, whose state is the 15-dimensional error, gives the same gain, covariance and correction."""
    rng = np.random.default_rng(6)
    transform, belief = UnscentedTransform(UkfConfig()), random_belief(rng)
    truth = oracle.plus(belief.x, 0.01 * rng.normal(size=15))
    R = np.diag([1e-5] * 3 + [1e-6] * 3 + [1e-4] * 3)[:size, :size]

    def seen(x):
        turn = so3.log(so3.quat_to_matrix(x[at.QUATERNION]) @ so3.quat_to_matrix(belief.x[at.QUATERNION]).T)
        return np.concatenate([x[:3], turn, so3.quat_to_matrix(x[at.QUATERNION]).T @ x[at.VELOCITY]])[:size]

    pose = VioPose(0, truth[at.POSITION], truth[at.QUATERNION], R[:6, :6], so3.quat_to_matrix(truth[at.QUATERNION]).T @ truth[at.VELOCITY],
                   np.eye(3))
    innovation = transform.innovate(belief, pose, R)
    points = MerweScaledSigmaPoints(15, unscented.ALPHA, unscented.BETA, unscented.KAPPA)
    theirs = UnscentedKalmanFilter(15, size, 0.0, lambda error: seen(oracle.plus(belief.x, error)), lambda x, dt: x, points)
    theirs.P, theirs.R = belief.P.copy(), R
    theirs.sigmas_f = points.sigma_points(np.zeros(15), belief.P)
    theirs.update(seen(truth))
    np.testing.assert_allclose(innovation.gain, theirs.K, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(innovation.gain @ innovation.residual, theirs.x, atol=1e-10)
    np.testing.assert_allclose(belief.P - innovation.gain @ innovation.S @ innovation.gain.T, theirs.P, atol=1e-12)


def test_an_update_moves_pose_and_velocity_towards_the_truth():
    rng = np.random.default_rng(7)
    transform, belief = UnscentedTransform(UkfConfig()), random_belief(rng)
    truth = oracle.plus(belief.x, np.r_[0.05, -0.03, 0.04, 0.1, -0.2, 0.1, 0.1, -0.05, 0.08, np.zeros(6)])
    pose = VioPose(0, truth[:3], truth[at.QUATERNION], np.eye(6), so3.quat_to_matrix(truth[at.QUATERNION]).T @ truth[at.VELOCITY], np.eye(3))
    after = transform.correct(belief, transform.innovate(belief, pose, np.diag([1e-8] * 9)))
    residual = oracle.minus(truth, after.x)
    assert np.linalg.norm(residual[:3]) < 2e-3 and np.linalg.norm(residual[6:9]) < 2e-3 and np.linalg.norm(residual[3:6]) < 0.05
    assert np.linalg.eigvalsh(after.P)[0] > 0


def test_a_covariance_that_is_not_positive_is_refused():
    transform, belief = UnscentedTransform(UkfConfig()), random_belief(np.random.default_rng(8))
    belief.P[4, 4] = -1.0
    with pytest.raises(CovarianceError):
        transform.predict(belief, random_run(np.random.default_rng(9)), 34)
    with pytest.raises(CovarianceError):
        transform.innovate(belief, VioPose(0, np.zeros(3), np.array([0, 0, 0, 1.0]), np.eye(6)), np.eye(6))


def test_at_rest_tilt_and_accelerometer_bias_are_one_unknown():
    """VIO's level is that of the same accelerometer: their sum, seen as a force, is known to the mean's noise."""
    config, rng, tilt = UkfConfig(), np.random.default_rng(13), 0.005
    q = so3.quat_exp(np.array([0.02, -0.01, 0.7]))
    up_B = so3.quat_to_matrix(q).T @ np.array([0.0, 0.0, GRAVITY])
    steps = np.column_stack([np.full(100, 0.002), np.zeros((100, 3)), up_B + rng.normal(0, 0.32, (100, 3)), np.full(100, 1e-4), np.full(100, 0.1)])
    pose = VioPose(200_000_000, np.zeros(3), q, np.diag([1e-6] * 3 + [tilt**2] * 3), np.zeros(3), np.eye(3) * 1e-4)
    belief = start.from_pose(config, pose, steps)
    H = np.zeros((3, 15))
    H[:, at.D_ATTITUDE], H[:, at.D_ACCEL_BIAS] = so3.hat(up_B), np.eye(3)
    noise = config.imu.accel_noise_density**2 / 0.2
    assert np.linalg.eigvalsh(H @ belief.P @ H.T)[-1] < noise
    across = np.linalg.svd(so3.hat(up_B))[0][:, 0]
    own = across @ belief.P[at.D_ACCEL_BIAS, at.D_ACCEL_BIAS] @ across
    prior = 1.0 / (1.0 / (tilt * GRAVITY) ** 2 + 1.0 / config.imu.accel_bias_init**2)
    assert prior < own < prior + noise  # alone, the bias is as unknown as the tilt makes it, or as it was made
