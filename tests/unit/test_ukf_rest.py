"""Rest in any attitude with no word from VIO: the covariance is bounded and honest, the biases are followed, a departure is noticed."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_core.values import RotorState
from perch_perception.ukf.rest import after_rest
from perch_perception.ukf.stillness import is_at_rest
from perch_perception.ukf.unscented import Belief
from perch_perception.ukf import Estimator, ImuSample, UkfConfig, VioOutcome, VioPose

CONFIG, RATE, SIGMA = UkfConfig(), 100.0, (0.03, 0.01)
PERIOD = round(1e9 / RATE)
ATTITUDES = {"ground": np.zeros(3), "wall": np.array([0.3, -1.4, 0.5]), "upside down": np.array([3.0, 0.2, 0.0])}


class Resting:
    """An estimator on a vehicle that rests: one pose, then the IMU alone, whose biases walk."""

    def __init__(self, seed=1, attitude="wall"):
        self.rng, imu, self.k = np.random.default_rng(seed), CONFIG.imu, 0
        self.q, self.p = so3.quat_exp(ATTITUDES[attitude]), np.array([1.0, 2.0, 1.2])
        self.up_B = so3.quat_to_matrix(self.q).T @ [0.0, 0.0, 9.81]
        self.bias = self.rng.normal(0.0, np.repeat([0.05, imu.accel_bias_init], 3))  # data sheets: at most 0.1 rad/s
        self.walk = np.repeat([imu.gyro_bias_walk, imu.accel_bias_walk], 3) / np.sqrt(RATE)
        self.noise = np.repeat([imu.gyro_noise_density, imu.accel_noise_density], 3) * np.sqrt(RATE)
        self.estimator = Estimator(CONFIG)
        self.run(0.5)
        e = self.rng.normal(0.0, np.repeat(SIGMA, 3))
        self.estimator.add_vio(VioPose((self.k - 2) * PERIOD, self.p + e[:3], so3.quat_multiply(so3.quat_exp(e[3:]), self.q),
                                       np.diag(np.repeat(SIGMA, 3) ** 2)))

    def run(self, duration, force=np.zeros(3)):
        drawn = self.rng.normal(size=(round(duration * RATE), 2, 6))
        biases = np.cumsum(np.vstack([self.bias, self.walk * drawn[:, 0]]), axis=0)[1:]
        self.bias, reads = biases[-1], biases + self.noise * drawn[:, 1]
        reads[:, 3:] += self.up_B
        reads[:, 3:] += force
        for read in reads.tolist():
            self.k += 1
            self.estimator.add_rotors(RotorState(self.k * PERIOD, (0.0,) * 4, (0.0,) * 4))
            self.estimator.add_imu(ImuSample(self.k * PERIOD, tuple(read[:3]), tuple(read[3:])))
        return self

    @property
    def error(self):
        e = self.estimator.estimate
        return np.concatenate([self.p - e.p_WB, -e.v_WB, so3.quat_log(so3.quat_multiply(so3.quat_conjugate(e.q_WB), self.q)),
                               self.bias[:3] - e.gyro_bias, self.bias[3:] - e.accel_bias])

    @property
    def sigma(self):
        return np.sqrt(np.diag(self.estimator.estimate.P))


@pytest.mark.parametrize("attitude, minutes", [("wall", 4.0), ("ground", 1.0), ("upside down", 1.0)])
@pytest.mark.slow
def test_the_covariance_does_not_grow_and_is_honest(attitude, minutes):
    """Minutes; what does not grow in four does not grow in sixty."""
    resting = Resting(attitude=attitude).run(10.0)
    before = resting.sigma
    resting.run(60.0 * minutes - 10.0)
    pose, velocity = np.r_[0:3, 6:9], slice(3, 6)
    np.testing.assert_allclose(resting.sigma[pose], before[pose], rtol=0.02)
    np.testing.assert_allclose(resting.sigma[velocity], before[velocity], rtol=0.3)  # of the last 0.1 s of noise, as measured over 25 samples
    assert resting.sigma[9:12].max() < 0.001 and resting.sigma[:3].max() < 0.031
    assert np.linalg.norm(resting.error[:3]) < 0.12 and np.abs(resting.error[9:12]).max() < 0.003  # the gyro's bias walked by 0.003
    assert resting.error @ np.linalg.solve(resting.estimator.estimate.P, resting.error) < 37.7  # chi2, 15, 99.9 %


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariance_says():
    flights = [Resting(seed).run(10.0) for seed in range(20)]
    nees = [f.error @ np.linalg.solve(f.estimator.estimate.P, f.error) for f in flights]
    assert 11.2 < np.mean(nees) < 19.4  # chi2, 15 x 20, 99.9 %, about


def test_a_departure_is_not_held_back():
    resting = Resting(attitude="ground").run(5.0)
    resting.run(0.5, force=np.array([0.0, 0.0, 3.0]))
    assert resting.estimator.estimate.v_WB[2] == pytest.approx(1.5, abs=0.1)
    assert resting.estimator.estimate.p_WB[2] - resting.p[2] == pytest.approx(0.375, abs=0.13)


def steps(gyro, accel, rate=500.0, n=None, seed=1):
    """IMU steps of 0.2 s with the IMU's noise about readings, (n, 9)."""
    rng, imu, n = np.random.default_rng(seed), CONFIG.imu, n or round(0.2 * rate)
    sigma = np.array([imu.gyro_noise_density, imu.accel_noise_density]) * np.sqrt(rate)
    rows = np.empty((n, 9))
    rows[:, 0], rows[:, 7:] = 1.0 / rate, sigma**2
    rows[:, 1:4], rows[:, 4:7] = gyro + rng.normal(0.0, sigma[0], (n, 3)), accel + rng.normal(0.0, sigma[1], (n, 3))
    return rows


UP, KNOWN = np.array([0.0, 0.0, 9.81]), np.full(6, 1e-6)


def test_flight_fall_and_turning_are_not_rest():
    t, axis = 0.002 * np.arange(100), np.array([0.0, 1.0, 0.0])
    shaken = 0.1 * np.sin(20.0 * t)[:, None] * axis
    assert is_at_rest(steps(0.0, UP)) and is_at_rest(steps(0.004, -UP), np.r_[np.full(3, 0.004), np.zeros(3)], KNOWN)
    for biases in ((), (np.zeros(6), KNOWN)):
        assert not is_at_rest(steps(0.0, 0.0 * UP), *biases)             # it falls
        assert not is_at_rest(steps(shaken, UP), *biases)                # held up by rotors
        assert not is_at_rest(steps(0.0, 1.2 * UP), *biases)             # it climbs
        assert not is_at_rest(steps(0.0, UP, n=50), *biases)             # too short to say
        assert not is_at_rest(steps(0.5 * axis, UP), *biases)            # it turns as no bias does
    assert not is_at_rest(steps(0.05 * axis, UP), np.zeros(6), KNOWN)    # it turns steadily
    assert is_at_rest(steps(0.05 * axis, UP), np.zeros(6), np.full(6, 0.05**2))  # as far as anybody knows, it rests


@pytest.mark.parametrize("rate", [100.0, 200.0, 400.0, 1000.0])
@pytest.mark.parametrize("turn", [np.zeros(3), np.array([0.0, 1.5, 0.0]), np.array([3.0, 0.3, -1.0])], ids=["upright", "on its nose", "upside down"])
def test_rest_is_in_the_variance_whatever_the_biases(rate, turn):
    rng, R = np.random.default_rng(3), so3.exp(turn)
    seen = []
    for seed in range(20):
        b_g, b_a = (size * v / np.linalg.norm(v) for size, v in zip((0.2, 1.0), rng.normal(size=(2, 3))))
        rows = steps(b_g, R.T @ UP + b_a, rate, seed=seed)
        seen += [is_at_rest(rows), is_at_rest(rows, np.r_[b_g, b_a], KNOWN)]
        assert not is_at_rest(rows, np.zeros(6), KNOWN)
        rows[:, 1:4] += rng.normal(0.0, 0.05, (len(rows), 3))
        assert not is_at_rest(rows)
    assert all(seen)


def flown_without_vio(coasting, R_WB, vibration, speed=None):
    """At 1 m/s, then it brakes and is still; VIO ends before. `vibration`: of the accelerometer in flight [m/s^2]; `speed`: of the rotors, as reported [rad/s].

    Returns:
        The estimate, and the position along x.
    """
    rng, estimator, p, v = np.random.default_rng(0), Estimator(CONFIG), 0.0, 0.0
    for k in range(1, round(500 * (2.0 + coasting))):
        t = 0.002 * k
        a = 2.5 if 0.3 < t <= 0.7 else -5.0 if 1.0 + coasting < t <= 1.2 + coasting else 0.0
        p, v = p + 0.002 * v + 0.5 * a * 0.002**2, v + 0.002 * a
        shaken = vibration if 0.3 < t <= 1.2 + coasting else 0.335
        if speed is not None:
            estimator.add_rotors(RotorState(2_000_000 * k, (speed,) * 4, (0.0,) * 4))
        estimator.add_imu(ImuSample(2_000_000 * k, tuple(rng.normal(0.0, 0.011, 3)), tuple(rng.normal(R_WB.T @ [a, 0.0, 9.81], shaken))))
        if t <= 1.0 and k > 100 and k % 16 == 0:
            estimator.add_vio(VioPose(2_000_000 * k, np.array([p, 0.0, 1.0]), so3.quat_from_matrix(R_WB), 1e-5 * np.eye(6),
                                      R_WB.T @ [v, 0.0, 0.0], 1e-4 * np.eye(3)))
    return estimator.estimate, p


@pytest.mark.parametrize("coasting", [0.6, 1.0, 2.5])
def test_a_flight_without_vio_before_the_rest_is_not_left_out(coasting):
    """The IMU that is kept is shorter than the flight, which ends on a wall."""
    found, p = flown_without_vio(coasting, so3.exp(ATTITUDES["wall"]), vibration=1.0, speed=0.0)
    assert abs(found.v_WB[0]) < 0.01 and abs(found.p_WB[0] - p) < 3.0 * np.sqrt(found.P[0, 0])


@pytest.mark.parametrize("R_WB", [np.eye(3), so3.exp(ATTITUDES["wall"])], ids=["z up", "any axes"])
@pytest.mark.parametrize("speed", [None, 600.0])
def test_a_vehicle_that_has_flown_may_hover_where_its_imu_is_quiet(speed, R_WB):
    """The noise of the sensor file includes the vibration of flight."""
    found, _ = flown_without_vio(1.0, R_WB, vibration=0.335, speed=speed)
    assert np.sqrt(np.diag(found.P)[3:6]).min() > 0.02


@pytest.mark.parametrize("coasting_after", [0.001, 0.05, 0.1, 0.15, 1.0])
def test_rest_holds_for_any_age_that_counts_as_coasting(coasting_after):
    resting = Resting()
    resting.estimator.config = replace(CONFIG, coasting_after=coasting_after)
    estimate = resting.run(3.0).estimator.estimate
    assert estimate is not None and resting.estimator.status.broken == 0
    assert np.sqrt(np.diag(estimate.P)[3:6]).max() < 0.02


def test_a_pose_that_the_imu_history_does_not_reach_is_too_old():
    """After a pause of VIO the oldest anchor may be older than the IMU samples that are kept."""
    rng, outcomes = np.random.default_rng(0), set()
    for pause in range(1000, 1520, 60):
        estimator = Estimator(CONFIG)
        for k in range(1, (pause + 720) // 2):
            now = 2_000_000 * k
            estimator.add_imu(ImuSample(now, tuple(rng.normal(0.0, 0.01, 3)), tuple(rng.normal([0.0, 0.0, 9.81], 2.0))))
            if now > 200_000_000 and k % 16 == 0 and now <= pause * 1_000_000:
                estimator.add_vio(VioPose(now - 40_000_000, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]), 1e-5 * np.eye(6)))
        stamp = (pause + 50) * 1_000_000
        outcome = estimator.add_vio(VioPose(stamp, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]), 1e-5 * np.eye(6)))
        assert (outcome is VioOutcome.TOO_OLD) or stamp >= estimator._imu.oldest
        outcomes.add(outcome)
    assert VioOutcome.TOO_OLD in outcomes


@pytest.mark.parametrize("gap", [0.6, 2.0, 10.0])
def test_an_imu_that_comes_back_at_rest_after_a_gap_longer_than_its_history_is_no_error(gap):
    resting = Resting()
    resting.k += round(gap * RATE)
    assert resting.run(1.0).estimator.estimate is not None


@pytest.mark.parametrize("measured", [0, 5])
def test_a_gap_at_rest_measures_no_bias(measured):
    """The NEES of the gyro's biases, of 200 draws; without samples they only walk."""
    imu, errors, P = CONFIG.imu, [], np.diag(np.repeat([0.03, 0.002, 0.01, 0.05, 0.2], 3) ** 2)
    for seed in range(200):
        bias = np.random.default_rng(seed).normal(0.0, 0.05, 3)
        rows = steps(bias, UP, n=measured + 1, seed=seed + 1000)
        rows[0, 0], rows[0, 7:] = 0.4, rows[0, 7:] + [4.0, 25.0]  # as `ImuBuffer` gives a gap
        found = after_rest(Belief(0, np.r_[np.zeros(9), 1.0, np.zeros(6)], P), rows, 410_000_000, CONFIG)
        errors.append(bias - found.x[10:13])
    nees = np.mean([e @ np.linalg.solve(found.P[9:12, 9:12], e) for e in errors])
    assert 2.46 < nees < 3.59  # chi2, 3 x 200, 99.9 %
    if not measured:
        np.testing.assert_allclose(np.diag(found.P)[9:12], 0.05**2 + imu.gyro_bias_walk**2 * 0.4)
