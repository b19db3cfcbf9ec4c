"""The estimator as a whole: accuracy, delay, consistency, and every fault of its inputs."""

import functools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from perch_core import so3
from perch_core.vehicle import load_vehicle
from perch_eval import consistency
from perch_eval.perch_motion import PerchMotion, PerchMotionConfig, read_imu
from perch_perception.ukf import Estimator, Health, ImuOutcome, ImuSample, UkfConfig, VioNoise, VioOutcome, VioPose

DT = 0.002
IMU = load_vehicle("snapdragon").imu
MS = 1_000_000
WHITE = (0.002, 0.002)          # VIO's white noise of the tests [m, rad]
DRIFT = (0.010, 0.004)          # VIO's drift of the tests [m/sqrt(s), rad/sqrt(s)]


@functools.lru_cache(maxsize=None)
def motion_of(seed, distance=1.7):
    motion = PerchMotion(PerchMotionConfig(distance=distance), seed)
    return motion.sample(np.arange(0.0, motion.duration - 0.003, DT))


@dataclass
class Flight:
    """An estimator fed with a perch: readings, VIO poses that drift, and what came out."""

    seed: int = 0
    latency: float = 0.040
    config: UkfConfig = UkfConfig()

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        self.truth = motion_of(self.seed)
        self.readings = read_imu(self.truth, IMU, self.rng)
        self.q = self.truth.q_WB
        self.estimator = Estimator(self.config)
        self.poses = self.make_poses()

    def make_poses(self):
        n, h = len(self.truth.times), 17 * DT
        d = self.rng.normal(0, 1, 6) * np.repeat([0.002, 0.003], 3)
        C = np.diag(np.repeat([0.002**2, 0.003**2], 3))
        poses = {}
        for k in range(160, n, 17):
            W = np.diag(np.repeat([DRIFT[0] ** 2 * h, DRIFT[1] ** 2 * h], 3))
            d, C = d + self.rng.multivariate_normal(np.zeros(6), W), C + W
            p = self.truth.p_WB[k] + d[:3] + self.rng.normal(0, WHITE[0], 3)
            q = so3.quat_multiply(so3.quat_exp(d[3:] + self.rng.normal(0, WHITE[1], 3)), self.q[k])
            poses[k] = VioPose(k * 2 * MS, p, q, C, self.truth.v_WB[k])
        return poses

    def sample(self, k):
        return ImuSample(k * 2 * MS, tuple(self.readings.gyro[k]), tuple(self.readings.accel[k]))

    def step(self, k, imu=True):
        delay = round(self.latency / DT)
        if k - delay in self.poses:
            self.vio_outcome = self.estimator.add_vio(self.poses[k - delay])
        if imu:
            self.imu_outcome = self.estimator.add_imu(self.sample(k))

    def fly(self, start=0, end=None):
        for k in range(start, end or len(self.truth.times)):
            self.step(k)
        return self

    def error(self):
        e = self.estimator.estimate
        k = round(e.stamp / (2 * MS))
        r = self.readings
        return np.concatenate([self.truth.p_WB[k] - e.p_WB, self.truth.v_WB[k] - e.v_WB,
                               consistency.attitude_error(self.q[k], e.q_WB),
                               r.gyro_bias[k] - e.gyro_bias, r.accel_bias[k] - e.accel_bias])

    def assert_sane(self):
        e = self.estimator.estimate
        assert np.isfinite(np.concatenate([e.p_WB, e.v_WB, e.q_WB, e.w_WB_B, e.P.ravel()])).all()
        assert np.linalg.eigvalsh(e.P)[0] > 0
        assert abs(np.linalg.norm(e.q_WB) - 1) < 1e-9

    def sigma(self):
        return np.sqrt(np.diag(self.estimator.estimate.P))


def relative_rmse(latency, seeds=4):
    """Position RMSE against VIO's own (drifting) map in the perch: what delay compensation can influence."""
    squares = []
    for seed in range(seeds):
        flight = Flight(seed, latency=latency).fly(end=2400)
        for k in range(2400, len(flight.truth.times)):
            flight.step(k)
            squares.append(flight.error()[:3] ** 2)
    return np.sqrt(np.mean(squares))


def test_before_vio_it_is_level_and_says_that_the_position_is_unknown():
    flight = Flight().fly(end=150)
    e, status = flight.estimator.estimate, flight.estimator.status
    assert status.health is Health.INITIALISING
    assert np.degrees(np.linalg.norm(so3.quat_log(e.q_WB))) < 2.0
    assert flight.sigma()[0] > 100.0
    flight.assert_sane()


def test_starts_at_rest_with_the_gyro_bias():
    flight = Flight(3).fly(end=400)
    assert flight.estimator.status.health is Health.RUNNING
    assert np.abs(flight.error()[9:12]).max() < 4 * IMU.gyro_noise / 10
    assert np.abs(flight.error()[3:6]).max() < 0.05


def test_starts_in_motion_from_vios_pose_and_velocity():
    flight = Flight(4)
    flight.poses = {k: v for k, v in flight.poses.items() if k > 2000}  # VIO comes up in mid-flight
    flight.fly(end=2400)
    assert flight.estimator.status.health is Health.RUNNING
    assert np.linalg.norm(flight.error()[:3]) < 0.15
    assert np.linalg.norm(flight.error()[3:6]) < 0.15


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


def test_it_is_where_vio_is_however_vio_drifts():
    """VIO has used the same IMU and the images: the filter must not be further from the truth than VIO."""
    flight, off, own = Flight(6, latency=0.0), [], []
    for k in range(len(flight.truth.times)):
        flight.step(k)
        if k > 600 and k in flight.poses:
            off.append(flight.estimator.estimate.p_WB - flight.poses[k].p_WB)
            own.append(flight.truth.p_WB[k] - flight.poses[k].p_WB)
    assert np.linalg.norm(own, axis=1).max() > 0.02                           # VIO drifts by centimetres
    assert np.sqrt(np.mean(np.square(off))) < 0.6 * WHITE[0]                  # and the filter with it


def test_vios_velocity_is_followed_as_far_as_its_covariance_is_good():
    """A velocity that VIO knows well is taken with the pose; one that it hardly knows changes nothing."""
    errors = {}
    for sigma in (0.003, 3.0):
        flight = Flight(7, latency=0.0).fly(end=1200)
        k = min(k for k in flight.poses if k >= 1200)
        wrong = flight.truth.v_WB[k] + [0.03, 0.0, 0.0]
        flight.poses[k] = replace(flight.poses[k], v_WB=wrong, velocity_covariance=np.eye(3) * sigma**2)
        flight.fly(start=1200, end=k + 1)
        errors[sigma] = np.abs(flight.estimator.estimate.v_WB - wrong).max()
        flight.assert_sane()
    assert errors[0.003] < 0.005 < 0.015 < errors[3.0]


def test_forty_milliseconds_of_delay_cost_less_than_a_fifth():
    prompt, late = relative_rmse(0.0), relative_rmse(0.040)
    assert late < 1.2 * prompt


def test_nees_of_pose_and_velocity_lies_within_its_bounds():
    """14 runs in which VIO's errors are correlated in time: averages inside 95 % bounds for most of the time."""
    samples, times = [], None
    for seed in range(14):
        flight, run, when = Flight(seed + 50).fly(end=300), [], []
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


def test_a_white_noise_filter_would_be_overconfident():
    """The reason for the drift states: the same total error, taken as white, is believed to average out."""
    white = VioNoise(position=0.02, attitude=0.008, drift_position=1e-6, drift_attitude=1e-6)
    careless = UkfConfig(vio=white)
    values = []
    for seed in range(4):
        flight = Flight(seed + 50, config=careless)
        tiny = np.eye(6) * 1e-10
        flight.poses = {k: replace(p, covariance=tiny) for k, p in flight.poses.items()}
        flight.fly()
        values.append(consistency.nees(flight.error()[:3], flight.estimator.estimate.P[:3, :3]) / 3)
    assert np.mean(values) > 4.0


def test_same_inputs_give_the_same_bits():
    a, b = Flight(6).fly(), Flight(6).fly()
    assert a.estimator.estimate.p_WB.tobytes() == b.estimator.estimate.p_WB.tobytes()
    assert a.estimator.estimate.P.tobytes() == b.estimator.estimate.P.tobytes()


def test_an_update_in_parts_ends_where_one_at_once_does():
    at_once, in_parts = Flight(6).fly(end=1500), Flight(6).fly(end=1500)
    k = next(k for k in range(1500, 1520) if k - 20 in at_once.poses)
    for flight in (at_once, in_parts):
        flight.fly(1500, k)
    before = in_parts.estimator.estimate.p_WB
    assert in_parts.estimator.add_vio(in_parts.poses[k - 20], at_once=False) is VioOutcome.APPLIED
    assert in_parts.estimator.behind and (in_parts.estimator.estimate.p_WB == before).all()
    for flight in (at_once, in_parts):
        flight.estimator.add_imu(flight.sample(k))
    at_once.estimator.add_vio(at_once.poses[k - 20])
    for part in range(3):
        assert in_parts.estimator.behind
        in_parts.estimator.go_on()
    in_parts.estimator.go_on()  # in real time late steps come together: one asks again before the other has gone on
    assert not in_parts.estimator.behind
    assert at_once.estimator.estimate.p_WB.tobytes() == in_parts.estimator.estimate.p_WB.tobytes()
    assert at_once.estimator.estimate.P.tobytes() == in_parts.estimator.estimate.P.tobytes()


def test_coasts_without_vio_grows_its_covariance_and_recovers():
    flight = Flight(7).fly(end=1500)
    before = flight.sigma()[:3].max()
    kept, flight.poses = flight.poses, {k: v for k, v in flight.poses.items() if not 1500 - 25 <= k < 1900}
    for k in range(1500, 1880):
        flight.step(k)
    assert flight.estimator.status.health is Health.COASTING
    assert flight.estimator.status.vio_age > 0.5  # longer than the kept IMU history
    coasting = flight.sigma()[:3].max()
    assert coasting > 1.5 * before
    assert np.abs(flight.error()[:3]).max() < 5 * coasting
    flight.poses = kept
    flight.fly(1880, 2100)
    assert flight.estimator.status.health is Health.RUNNING
    assert flight.sigma()[:3].max() < coasting
    flight.assert_sane()


@pytest.mark.parametrize(("change", "outcome"), [
    (lambda p, now: replace(p, stamp=now + 200 * MS), VioOutcome.FUTURE),
    (lambda p, now: replace(p, stamp=now + 10 * MS), VioOutcome.WAITING),
    (lambda p, now: replace(p, stamp=now - 2_000 * MS), VioOutcome.OUT_OF_ORDER),
    (lambda p, now: replace(p, p_WB=np.array([np.nan, 0, 0])), VioOutcome.NOT_FINITE),
    (lambda p, now: replace(p, q_WB=np.zeros(4)), VioOutcome.NOT_FINITE),
    (lambda p, now: replace(p, covariance=-np.eye(6)), VioOutcome.BAD_COVARIANCE),
    (lambda p, now: replace(p, p_WB=p.p_WB + [1.0, 0, 0]), VioOutcome.GATED),
])
def test_unusable_poses_are_refused_with_the_reason(change, outcome):
    flight = Flight(8).fly(end=1500)
    before = flight.estimator.estimate.p_WB.copy()
    pose = flight.poses[max(k for k in flight.poses if k < 1500)]
    now = 1499 * 2 * MS
    assert flight.estimator.add_vio(change(pose, now)) is outcome
    np.testing.assert_array_equal(flight.estimator.estimate.p_WB, before)
    if outcome is not VioOutcome.WAITING:
        assert outcome.value in flight.estimator.status.message
    flight.fly(1500, 1600)
    flight.assert_sane()


def test_a_pose_used_twice_is_a_duplicate():
    flight = Flight(9).fly(end=1500)
    used = flight.poses[max(k for k in flight.poses if k + 20 < 1500)]
    assert flight.estimator.add_vio(used) is VioOutcome.DUPLICATE


def test_a_pose_before_the_imu_has_come_is_refused():
    flight = Flight(9)
    assert flight.estimator.add_vio(flight.poses[160]) is VioOutcome.NO_IMU


def test_a_waiting_pose_is_applied_when_the_imu_gets_there():
    ahead, prompt = Flight(10, latency=-0.010), Flight(10, latency=0.0)
    ahead.fly(end=1500)
    prompt.fly(end=1500)
    assert ahead.estimator.status.accepted >= prompt.estimator.status.accepted - 1 > 50
    np.testing.assert_allclose(ahead.estimator.estimate.p_WB, prompt.estimator.estimate.p_WB, atol=2e-3)


def test_a_jump_of_vios_map_is_gated_first_and_accepted_when_it_lasts():
    flight = Flight(11).fly(end=1500)
    flight.poses = {k: replace(p, p_WB=p.p_WB + [0.5, 0, 0]) if k >= 1480 else p for k, p in flight.poses.items()}
    flight.fly(1500, 1600)
    assert flight.estimator.status.rejected > 0
    assert np.abs(flight.error()[:3]).max() < 0.1  # the jump is not followed while it is gated
    flight.fly(1600, 2200)
    assert flight.estimator.status.health is Health.RUNNING
    assert flight.sigma()[0] > 0.2  # it cannot know which of both was right, and says so
    flight.assert_sane()


@pytest.mark.parametrize(("make", "outcome"), [
    (lambda s: replace(s, w_B=(float("nan"), 0.0, 0.0)), ImuOutcome.NOT_FINITE),
    (lambda s: replace(s, f_B=(0.0, float("inf"), 0.0)), ImuOutcome.NOT_FINITE),
    (lambda s: replace(s, w_B=(34.0, 0.0, 0.0)), ImuOutcome.SATURATED),
    (lambda s: replace(s, f_B=(0.0, 0.0, -156.0)), ImuOutcome.SATURATED),
    (lambda s: replace(s, stamp=s.stamp - 20 * MS), ImuOutcome.NOT_NEWER),
])
def test_bad_imu_samples_are_bridged_with_a_larger_covariance(make, outcome):
    good, bad = Flight(12).fly(end=1500), Flight(12).fly(end=1500)
    for k in range(1500, 1505):
        good.step(k)
        bad.step(k, imu=False)
        assert bad.estimator.add_imu(make(bad.sample(k))) is outcome
        assert outcome.value in bad.estimator.status.message
    bad.assert_sane()
    if outcome is not ImuOutcome.NOT_NEWER:
        assert np.all(bad.sigma()[:9] >= 0.99 * good.sigma()[:9])
        assert bad.sigma()[3:9].max() > 1.2 * good.sigma()[3:9].max()
    bad.fly(1505, 2000)
    assert np.linalg.norm(bad.error()[:3]) < 0.15
    bad.assert_sane()


def test_an_imu_gap_grows_the_covariance_and_heals():
    flight = Flight(13).fly(end=1500)
    before = flight.sigma()
    for k in range(1500, 1525):  # 50 ms
        flight.step(k, imu=False)
    flight.fly(1525, 1526)
    assert flight.imu_outcome is ImuOutcome.GAP
    assert np.all(flight.sigma()[3:9] > 1.5 * before[3:9])
    flight.fly(1526, 2000)
    assert np.linalg.norm(flight.error()[:3]) < 0.15
    flight.assert_sane()


def test_a_first_sample_that_is_not_finite_is_refused():
    estimator = Estimator()
    assert estimator.add_imu(ImuSample(0, (float("nan"),) * 3, (0.0, 0.0, 9.81))) is ImuOutcome.EMPTY
    assert estimator.estimate is None
