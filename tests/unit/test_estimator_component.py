"""The estimator as a component: what goes in and out of its ports, at every IMU rate, and under every fault of its inputs."""

import math

import numpy as np
import pytest
from perch_core import so3
from perch_core.values import ImuSample, InertialState, OdometryState, Transform
from perch_perception.estimator_component import StateEstimator
from perch_perception.ukf import UkfConfig
from perch_perception.vio_component import VioComponent, VioComponentConfig

from unit.component_outputs import Outputs

MS = 1_000_000
LEVEL = (0.0, 0.0, 0.0, 1.0)


def odometry(stamp, p=(0.0, 0.0, 1.0), q=LEVEL, sigma=0.01, frame="odom", **changes):
    value = OdometryState(stamp, p, q, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.eye(6) * sigma**2, np.eye(6) * 0.02**2, frame)
    return value._replace(**changes)


def state(stamp, p=(0.0, 0.0, 1.0), **changes):
    value = InertialState(stamp, np.array(p), np.array(LEVEL), np.zeros(3), np.zeros(3), np.zeros(3), np.eye(15) * 1e-4)
    return value._replace(**changes)


class Hover:
    """An estimator over a hover: IMU at a rate, VIO at 30 Hz, everything exact."""

    def __init__(self, rate=500.0, config=UkfConfig(), frame="imu_link", vio=odometry, start=0):
        self.estimator = StateEstimator(config)
        self.out = Outputs(self.estimator)
        self.period, self.now, self.next_vio, self.frame, self.vio = round(1e9 / rate), start, start + 100 * MS, frame, vio

    def sample(self, **changes):
        return ImuSample(self.now, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), self.frame)._replace(**changes)

    def fly(self, duration):
        end = self.now + round(duration * 1e9)
        while self.now < end:
            self.now += self.period
            if self.vio is not None and self.now >= self.next_vio:
                self.tell(self.vio(self.next_vio))
                self.next_vio += 33 * MS
            self.estimator.on_imu(self.sample())
        return self

    def tell(self, value):
        (self.estimator.on_vio_state if isinstance(value, InertialState) else self.estimator.on_vio_odometry)(value)

    @property
    def last(self):
        return self.out["odometry"][-1]

    @property
    def health(self):
        return self.out["status"][-1]

    def assert_running(self, p=(0.0, 0.0, 1.0)):
        assert self.health.state == 1, self.health
        np.testing.assert_allclose(self.last.p_WB, p, atol=0.02)
        assert np.isfinite(self.last.pose_covariance).all() and np.linalg.eigvalsh(self.last.pose_covariance)[0] > 0


@pytest.mark.parametrize("rate", [100.0, 200.0, 333.0, 500.0, 1000.0])
@pytest.mark.parametrize("vio", [odometry, state])
def test_odometry_at_every_rate_of_the_imu(rate, vio):
    hover = Hover(rate, vio=vio).fly(2.0)
    stamps = [o.stamp for o in hover.out["odometry"]]
    samples = range(hover.period, hover.now + 1, hover.period)
    assert stamps == [t for t in samples if t >= 100 * MS]  # VIO's first pose
    hover.assert_running()
    assert hover.out.warnings() == []
    assert "gap" not in hover.health.message
    statuses = [s.stamp for s in hover.out["status"]]
    assert statuses[0] == samples[0] and hover.out["status"][0].state == 0
    np.testing.assert_allclose(np.diff(statuses), 100 * MS, atol=hover.period)
    assert np.abs(hover.last.v_WB).max() < 0.05
    assert [len(x) for x in (hover.last.p_WB, hover.last.q_WB, hover.last.v_B, hover.last.w_B)] == [3, 4, 3, 3]
    assert all(isinstance(x, float) for x in (*hover.last.p_WB, *hover.last.q_WB, *hover.last.v_B, *hover.last.w_B))
    assert hover.last.frame == "map"


@pytest.mark.parametrize("rate", [100.0, 200.0, 1000.0])
def test_the_covariance_of_a_second_without_vio_hardly_depends_on_the_rate(rate):
    """Noise is a density: a filter at 100 Hz is as sure as at 500 Hz."""
    sigmas = []
    for r in (500.0, rate):
        hover = Hover(r).fly(1.5)
        hover.vio = None
        hover.fly(1.0)
        sigmas.append(np.sqrt(np.diag(hover.last.pose_covariance)))
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=0.15)


def test_a_missing_stretch_of_samples_is_a_gap_at_100_hz_too():
    hover = Hover(100.0).fly(1.0)
    hover.now += 50 * MS
    hover.fly(0.01)
    assert "gap" in hover.estimator.filter.status.message
    hover.fly(1.0).assert_running()


def test_odometry_beside_a_state_that_waits_for_the_imu_is_ignored():
    """Images that come before the IMU has passed their exposure: VIO answers with the sample that does, maybe before the estimator has it."""
    hover = Hover(100.0, vio=None)
    for _ in range(30):
        hover.tell(state(hover.now + 5 * MS))
        hover.tell(odometry(hover.now + 5 * MS))
        hover.fly(0.01)
    hover.assert_running()
    assert hover.out.warnings() == []


def test_the_covariance_has_grown_with_the_first_sample_after_a_gap():
    hover = Hover(100.0, vio=state).fly(1.0)
    before, hover.vio = hover.last.pose_covariance[0, 0], None
    hover.now += 300 * MS
    hover.fly(0.01)
    assert hover.last.stamp == hover.now and before < 0.02**2 < 0.1**2 < hover.last.pose_covariance[0, 0]


def test_odometry_is_ignored_while_whole_states_come_and_used_after():
    """Both come with the same stamps, the odometry first, as a schedule sorts them; it is another 0.3 m away."""
    hover = Hover(vio=None)
    for k in range(60):
        hover.fly(0.033)
        if k >= 3:
            hover.tell(odometry(hover.now, p=(0.3, 0.0, 1.0)))
            hover.tell(state(hover.now))
    hover.fly(0.12).assert_running()
    accepted = hover.health.accepted
    for _ in range(20):
        hover.fly(0.033)
        hover.tell(odometry(hover.now))
    assert hover.health.accepted == accepted  # within a second
    for _ in range(30):
        hover.fly(0.033)
        hover.tell(odometry(hover.now))
    assert hover.health.accepted > accepted
    hover.assert_running()


@pytest.mark.parametrize("bad", [
    odometry(0, p=(math.nan, 0.0, 1.0)), odometry(0, q=(0.0, 0.0, 0.0, 0.0)), odometry(0, sigma=1e150), odometry(0, frame="base_link"),
    odometry(0, p=(0.0, 0.0)), odometry(0, pose_covariance=np.eye(3)), odometry(0, pose_covariance=-np.eye(6)),
    odometry(0, pose_covariance=np.full((6, 6), np.nan)), odometry(0, v_B=(math.inf, 0.0, 0.0)), odometry(0, twist_covariance=np.full((6, 6), 1e300)),
    state(0, gyro_bias=np.full(3, np.nan)), state(0, covariance=np.eye(6)), state(0, covariance=np.eye(15) * 1e300),
    state(0, q_WB=np.zeros(4)), state(0, frame="camera"), state(0, v_WB=np.zeros((3, 1)))])
def test_bad_measurements_are_dropped_with_a_warning_and_the_next_good_one_counts(bad):
    hover = Hover().fly(1.0)
    accepted = hover.health.accepted
    for _ in range(40):
        hover.tell(bad._replace(stamp=hover.now))
        hover.fly(0.02)
    assert hover.out.warnings()
    assert hover.health.accepted > accepted + 15
    hover.fly(0.2).assert_running()


def test_an_imu_that_begins_to_repeat_one_sample_is_silent():
    """One without noise from the beginning is not."""
    hover = Hover()
    hover.fly(1.0).assert_running()
    assert not hover.out.warnings()
    hover.sample = lambda: ImuSample(hover.now, (0.01, 0.0, 0.0), (0.0, 0.1, 9.8), "imu_link")
    before = hover.now
    hover.fly(0.3)
    assert any("the same sample 20 times in a row" in text for text in hover.out.warnings())
    assert hover.out["odometry"][-1].stamp <= before + 21 * hover.period
    hover.sample = lambda: ImuSample(hover.now, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81 + 1e-3 * (hover.now // hover.period % 2)), "imu_link")
    hover.fly(0.3).assert_running()


BODY, WORLD, ZERO = (lambda v, R: R.T @ v), (lambda v, R: v), (lambda v, R: np.zeros(3))


@pytest.mark.parametrize(("twist", "sigma", "jump", "warned"), [
    (BODY, 0.01, 0.0, False), (BODY, 0.01, 5.0, False), (WORLD, 0.1, 0.0, True), (WORLD, 0.01, 0.0, True), (ZERO, 0.01, 0.0, True), (ZERO, 0.0, 0.0, False)])
@pytest.mark.parametrize("period", [10, 34])
def test_a_twist_of_another_frame_is_named_and_not_used(twist, sigma, jump, warned, period):
    """Odometry of a curved flight with a yaw of 90 deg; a jump of the poses with a right twist changes no velocity."""
    estimator, rng, q, errors = StateEstimator(UkfConfig()), np.random.default_rng(0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)), []
    out, R = Outputs(estimator), so3.quat_to_matrix(np.array(q))
    for k in range(1500):
        t = 0.002 * k
        v, a = np.array([1.5, 1.5 * math.sin(2.0 * t), 0.0]), np.array([0.0, 3.0 * math.cos(2.0 * t), 9.81])
        p = np.array([1.5 * t + (jump if t > 2.0 else 0.0), -0.75 * math.cos(2.0 * t), 1.0])
        estimator.on_imu(ImuSample(2 * k * MS, tuple(rng.normal(0.0, 0.02, 3)), tuple(R.T @ a + rng.normal(0.0, 0.3, 3))))
        if 2 * k % period == 0:
            estimator.on_vio_odometry(odometry(2 * k * MS, tuple(p), q, v_B=tuple(twist(v, R)), twist_covariance=np.eye(6) * sigma**2))
        if out["odometry"]:
            last = out["odometry"][-1]
            errors.append(np.linalg.norm(R @ last.v_B - v) if t > 0.5 else 0.0)
    assert max(errors) < 0.1 and np.linalg.norm(last.p_WB - p) < 0.1 and out["status"][-1].state == 1
    assert any("twist" in text and "base_link" in text for text in out.warnings()) is warned


@pytest.mark.parametrize("shift", [-5_000 * MS, 5_000 * MS, 10**17])
def test_measurements_of_another_time_are_refused(shift):
    hover = Hover().fly(1.0)
    for _ in range(20):
        hover.tell(odometry(hover.now + shift, p=(5.0, 0.0, 1.0)))
        hover.fly(0.02)
    assert any("refused" in text for text in hover.out.warnings())
    hover.fly(0.2).assert_running()


def test_of_measurements_that_come_while_the_imu_is_silent_the_newest_twenty_wait():
    """They fill no memory, and the filter begins with the oldest of those."""
    hover = Hover(vio=None).fly(0.1)
    for k in range(25):
        hover.tell(odometry(hover.now, p=(0.1 * k, 0.0, 1.0)))
    hover.fly(0.01)
    assert any("vio/odometry: more than 20 values without an IMU sample" in text for text in hover.out.warnings())
    hover.assert_running((0.5, 0.0, 1.0))


def test_odometry_that_is_ignored_is_not_converted(monkeypatch):
    hover = Hover(vio=None).fly(0.1)
    hover.tell(state(hover.now))
    hover.fly(0.01).assert_running()
    monkeypatch.setattr("perch_perception.estimator_component.pose_of", None)
    hover.tell(odometry(hover.now))
    hover.fly(0.01).assert_running()
    assert hover.out.warnings() == []


def test_a_saturated_sample_gets_its_odometry():
    hover = Hover().fly(1.0)
    for _ in range(3):
        hover.now += hover.period
        hover.estimator.on_imu(hover.sample(w_B=(40.0, 0.0, 0.0)))
        assert hover.last.stamp == hover.now
    hover.fly(1.0).assert_running()


@pytest.mark.parametrize("kind, config", [(StateEstimator, UkfConfig), (VioComponent, VioComponentConfig)])
def test_gaps_and_saturated_samples_are_logged(kind, config):
    component = kind(config())
    out = Outputs(component)
    for stamp, rate in ((1000, 0.0), (1002, 0.1), (1004, 0.2), (1006, 0.3), (1400, 0.4), (1402, 40.0)):
        component.on_imu(ImuSample(stamp * MS, (rate, 0.0, 0.0), (0.0, 0.0, 9.81)))
    gap, saturated = out.warnings()
    assert f"{1400 * MS} ns used after a gap" in gap and f"{1402 * MS} ns used with inflated noise" in saturated


def test_samples_with_stamps_that_go_back_or_far_ahead_give_nothing():
    hover = Hover().fly(1.0)
    count = len(hover.out["odometry"])
    for shift in (0, -100 * MS, 3600 * 10**9, -3600 * 10**9):
        hover.estimator.on_imu(hover.sample(stamp=hover.now + shift))
    assert len(hover.out["odometry"]) == count
    assert sum("does not follow" in text for text in hover.out.warnings()) == 4
    hover.fly(0.5).assert_running()


@pytest.mark.parametrize("step", [22, 30, 100])
def test_a_clock_that_is_set_back_a_little_is_waited_for(step):
    hover = Hover().fly(1.0)
    hover.now -= step * MS
    count, hover.next_vio = len(hover.out["odometry"]), hover.now + 20 * MS
    hover.fly(0.001 * step)
    assert len(hover.out["odometry"]) <= count + 1  # they never go back
    hover.fly(0.5).assert_running()
    assert hover.last.stamp == hover.now and not any("restarting" in text for text in hover.out.warnings())


@pytest.mark.parametrize("number", [10, 50])
def test_samples_that_are_delivered_again_give_nothing(number):
    hover = Hover().fly(1.0)
    count = len(hover.out["odometry"])
    for k in range(number):
        hover.estimator.on_imu(hover.sample(stamp=hover.now - (number + 5 - k) * hover.period))
    assert len(hover.out["odometry"]) == count
    hover.fly(0.5).assert_running()
    assert not any("restarting" in text for text in hover.out.warnings())


@pytest.mark.parametrize("jump", [-1100 * MS, 3600 * 10**9])
def test_a_source_that_was_started_again_is_heard_again(jump):
    """Its stamps go on from elsewhere: the filter begins anew, with VIO's next measurement."""
    hover = Hover().fly(1.5)
    hover.now += jump
    hover.next_vio = hover.now + 100 * MS
    hover.fly(0.5)
    assert hover.last.stamp == hover.now
    assert any("restarting" in text for text in hover.out.warnings())
    hover.assert_running()


def test_axes_of_another_frame_are_turned_or_refused():
    turn = so3.quat_exp(np.array([0.0, 0.0, np.pi / 2]))  # x of the IMU along y of B
    hover = Hover(frame="my_imu")
    assert hover.fly(0.5).out["odometry"] == []
    assert any("'my_imu'" in text and "/tf_static" in text for text in hover.out.warnings())
    hover.estimator.on_transform(Transform("base_link", "plate", (0.0, 0.0, 0.1), LEVEL))
    hover.estimator.on_transform(Transform("plate", "my_imu", (0.0, 0.0, 0.0), tuple(turn)))
    for k in range(10):
        hover.now += hover.period
        if k == 5:
            hover.tell(state(hover.now))
        hover.estimator.on_imu(hover.sample(w_B=(0.1, 0.0, 0.0), f_B=(1.0, 0.0, 9.81)))
    np.testing.assert_allclose(hover.last.w_B, (0.0, 0.1, 0.0), atol=1e-12)
    assert any("0.100 m from base_link" in text for text in hover.out.warnings())


@pytest.mark.parametrize("transform", [
    Transform("base_link", "my_imu", (0.0, 0.0, math.nan), LEVEL), Transform("base_link", "my_imu", (0.0, 0.0, 0.0), (0.0,) * 4),
    Transform("base_link", "base_link", (0.0, 0.0, 0.0), LEVEL), Transform("my_imu", "other", (0.0, 0.0, 0.0), LEVEL)])
def test_a_transform_that_does_not_help_changes_nothing(transform):
    hover = Hover(frame="my_imu")
    hover.estimator.on_transform(transform)
    assert hover.fly(0.1).out["odometry"] == []


def test_covariances_are_new_every_few_samples_and_after_each_update():
    hover = Hover().fly(0.5)
    hover.vio, before = None, len(hover.out["odometry"])
    hover.fly(0.1)
    matrices = [o.pose_covariance for o in hover.out["odometry"][before:]]
    assert len({id(m) for m in matrices}) == pytest.approx(10, abs=1)
    while hover.last.pose_covariance is hover.out["odometry"][-2].pose_covariance:
        hover.fly(0.002)
    hover.tell(odometry(hover.now))
    hover.fly(0.002)
    assert hover.last.pose_covariance is not hover.out["odometry"][-2].pose_covariance


def test_same_inputs_same_bits():
    a, b = Hover().fly(1.0).out["odometry"], Hover().fly(1.0).out["odometry"]
    assert all(x[:5] == y[:5] and x.pose_covariance.tobytes() == y.pose_covariance.tobytes() for x, y in zip(a, b, strict=True))
