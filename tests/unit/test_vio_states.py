"""VIO with large IMU biases at every rate, from rest and in motion; what it says of itself where it is blind or wrong. Simulated tracks."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_core.imu_axes import ImuAxes
from perch_core.values import ImuSample, RotorState, Transform
from perch_core.vehicle import GRAVITY, load_vehicle
from open_loop.motion import PerchMotion, read_imu
from perch_perception.ukf.imu_buffer import ImuBuffer, ImuOutcome
from perch_perception.vio import FrameOutcome, VioConfig, VisualInertialOdometry
from perch_perception.vio import state as at
from perch_perception.vio.divergence import divergence, velocity_sigma
from perch_perception.vio.msckf import Msckf
from perch_perception.vio.start import configured_pose, initial_state
from perch_perception.vio.tracker import Features, Tracker

from unit.test_vio_filter import SimulatedTracks

VEHICLE = load_vehicle("snapdragon")
MOUNT = VEHICLE.mounts["down"]
GYRO_BIAS, ACCEL_BIAS = 0.2 * np.array([0.48, -0.6, 0.64]), 1.0 * np.array([0.6, 0.48, -0.64])
BLANK = np.zeros((MOUNT.camera.height, MOUNT.camera.width), np.uint8)


class GivenTracks(Tracker):
    """Features as somebody else has them."""

    def __init__(self, see):
        super().__init__(VioConfig().tracker, MOUNT.camera)
        self.see = see

    def track(self, image, R_now_before, slack=0.0):
        ids, pixels = self.see()
        self.latest = Features(ids, pixels, 0, np.zeros(len(ids)))
        return self.latest


class Flown:
    """A climb to a hover; the ground is a blur up to 0.3 m. The IMU's biases, given in its own axes, are large."""

    def __init__(self, rate, begin=0.0, seed=1, q_BI=(0.0, 0.0, 0.0, 1.0), gyro_bias=GYRO_BIAS):
        self.rng, self.motion, self.rate = np.random.default_rng(seed), PerchMotion(seed=seed), rate
        self.begin, self.tracks, self.now = begin, SimulatedTracks(np.random.default_rng(seed), 0.2), 0.0
        times = np.arange(begin, self.motion.perch_time, 1.0 / rate)
        noise = np.sqrt(rate / 500.0)  # the same density
        imu = replace(VEHICLE.imu, rate=rate, accel_noise=VEHICLE.imu.accel_noise * noise, gyro_noise=VEHICLE.imu.gyro_noise * noise)
        read = read_imu(self.motion.sample(times), imu, self.rng)
        axes, R_BI = ImuAxes(pytest.fail), so3.quat_to_matrix(np.array(q_BI))
        axes.add_transform(Transform("base_link", "turned", (0.0, 0.0, 0.0), q_BI))
        gyro, accel = read.gyro @ R_BI + gyro_bias, read.accel @ R_BI + ACCEL_BIAS
        self.gyro_bias = R_BI @ gyro_bias
        self.samples = [axes.in_body(ImuSample(round(t * 1e9), w, f, "turned")) for t, w, f in zip(times, gyro, accel)]
        config = VioConfig()
        config = replace(config, imu=replace(config.imu, accel_bias_init=0.6), calibration=replace(config.calibration, track=0.2))
        start = self.motion.sample(np.array([begin])).p_WB[0]
        self.vio = VisualInertialOdometry(config, MOUNT, start)
        self.vio.tracker = GivenTracks(self.see)

    def see(self):
        m = self.motion.sample(np.array([self.now]))
        if m.p_WB[0, 2] < 0.3:
            return np.zeros(0, int), np.zeros((0, 2))
        return self.tracks(m.p_WB[0], m.R_WB[0], MOUNT.R_BC)

    def fly(self):
        """(time, result, error of the velocity in B and its covariance, error of up in B [rad]) of each frame with a pose."""
        out, frame = [], self.begin + 0.1
        for sample in self.samples:
            self.vio.add_imu(sample)
            if sample.stamp * 1e-9 > frame + 0.02:
                self.now = frame
                result = self.vio.add_image(round((frame + MOUNT.stamp_offset) * 1e9), BLANK)
                if result.estimate is not None:
                    e, m = result.estimate, self.motion.sample(np.array([result.estimate.stamp * 1e-9]))
                    v = m.R_WB[0].T @ m.v_WB[0] - e.R_WB.T @ e.v_WB
                    out.append((frame, result, v, so3.angle_between(m.R_WB[0][2], e.R_WB[2])))
                frame += 1 / 30
        return out


@pytest.mark.slow
@pytest.mark.parametrize("begin, rate, more", [
    (0.0, 100.0, {}), (0.0, 1000.0, {}),
    (1.9, 100.0, dict(q_BI=(1.0, 0.0, 0.0, 0.0), gyro_bias=-GYRO_BIAS)),  # forward, right, down
    (1.9, 1000.0, dict(q_BI=(np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0), gyro_bias=np.array([0.0, 0.2, 0.0])))])  # up, right, forward
def test_large_biases_are_found(begin, rate, more):
    """From rest, and switched on in motion; the axes of the IMU may be turned in the body."""
    flown = Flown(rate, begin, **more)
    seen = flown.fly()
    first = seen[0][1]
    if begin == 0.0:
        assert first.outcome is FrameOutcome.RESTING and seen[0][0] < 0.5
        np.testing.assert_allclose(first.estimate.gyro_bias, flown.gyro_bias, atol=0.02)
        assert {r.outcome for t, r, _, _ in seen if 0.5 < t < 1.0} == {FrameOutcome.RESTING}
    else:
        assert first.outcome is FrameOutcome.TRACKING
        np.testing.assert_allclose(first.estimate.gyro_bias, flown.gyro_bias, atol=0.05)
    _, last, v, tilt = seen[-1]
    assert last.outcome is FrameOutcome.TRACKING and last.restarts == 0
    np.testing.assert_allclose(last.estimate.gyro_bias, flown.gyro_bias, atol=0.03)
    # a bias across g looks like a tilt: 1 m/s^2 is 5.8 deg at rest, and a climb tells little of it
    estimate = last.estimate
    level = np.eye(3) - np.outer(estimate.R_WB[2], estimate.R_WB[2])
    sigma = np.sqrt(np.linalg.eigvalsh(level @ estimate.P[6:9, 6:9] @ level)[-1])
    assert np.linalg.norm(v) < 0.15 and tilt < 3.0 * sigma and np.degrees(sigma) < 5.8
    assert v @ np.linalg.solve(last.estimate.velocity_covariance, v) < 16.3  # chi2, 3, 99.9 %


def standing(see, until, shake=0.0):
    """VIO on a vehicle that rests for 1 s before a dark camera; then features as `see(k)` has them in frame k, while the IMU shakes."""
    rng, vio, out, frame = np.random.default_rng(2), VisualInertialOdometry(VioConfig(), MOUNT), [], 0.1
    vio.tracker = GivenTracks(lambda: see(len(out)) if frame > 1.0 else (np.zeros(0, int), np.zeros((0, 2))))
    for k in range(round(500 * until)):
        w = rng.normal(0.0, 0.01, 3) + (shake * np.sin(60.0 * 0.002 * k) if k > 500 else 0.0)
        vio.add_imu(ImuSample(2_000_000 * k, tuple(w), tuple(rng.normal(0.0, 0.3, 3) + [0.0, 0.0, GRAVITY])))
        if 0.002 * k > frame + 0.02:
            out.append((frame, vio.add_image(round(1e9 * frame), BLANK), vio.filter.state.P.copy() if vio.filter else None))
            frame += 1 / 30
    return out


def test_tracks_that_are_never_used_are_blindness():
    """Each lives for three frames: there are always 60 of them, and they tell nothing."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([40, 40], [600, 440], (400, 60, 2))
    out = standing(lambda k: (60 * (k // 3) + np.arange(60), pixels[k // 3] + 2.0 * (k % 3)), 4.0, shake=0.3)
    assert {(r.features, r.used) for t, r, _ in out if t > 1.1} == {(60, 0)}
    late = [(t, r, P) for t, r, P in out if t > 2.5 and P is not None]
    assert late and all(r.outcome is FrameOutcome.BLIND and r.estimate is None and r.blind_for > 0.5 for _, r, _ in late)
    (t_1, _, first), (t_2, _, last) = late[0], late[-1]
    grown = np.diag(last - first)[at.VELOCITY]
    assert (grown >= 0.99 * VioConfig().imu.accel_noise_density**2 * (t_2 - t_1)).all()


def test_a_filter_that_does_not_fit_what_it_sees_starts_again_and_says_so():
    """The camera flies over a scene at 2 m/s, and the IMU knows nothing of it."""
    points = np.random.default_rng(1).uniform([-3.0, -3.0, 1.0], [12.0, 3.0, 1.5], (400, 3))

    def see(k):
        pixels, valid = MOUNT.camera.project(points - [2.0 / 30 * k, 0.0, 0.0])
        ids = np.flatnonzero(valid & MOUNT.camera.contains(pixels, 8))[:80]
        return ids, pixels[ids]

    out = standing(see, 1.8, shake=0.3)
    lost = [r for _, r, _ in out if r.message.startswith("lost:") and r.outcome is FrameOutcome.LOST]
    assert lost and "refused" in lost[0].message and lost[0].estimate is None
    assert out[-1][1].restarts >= 1


def test_a_covariance_that_is_not_positive_definite_is_a_loss():
    """In flight: the pose is kept, as uncertain as the covariance was wrong."""
    flown, frame, outcomes = Flown(200.0), 0.1, []
    for sample in flown.samples:
        if sample.stamp > 3.6e9:
            break
        flown.vio.add_imu(sample)
        if sample.stamp * 1e-9 > frame + 0.02:
            if flown.now < 2.6 <= frame:
                flown.vio.filter.state.P[at.POSITION, at.POSITION] -= 0.1 * np.eye(3)
            flown.now = frame
            result = flown.vio.add_image(round((frame + MOUNT.stamp_offset) * 1e9), BLANK)
            outcomes += [result] if frame >= 2.6 else []
            frame += 1 / 30
    assert outcomes[0].outcome is FrameOutcome.LOST and "positive definite" in outcomes[0].message
    assert outcomes[-1].outcome is FrameOutcome.TRACKING and outcomes[-1].restarts == 1
    off = outcomes[-1].estimate.p_WB - flown.motion.sample(np.array([outcomes[-1].estimate.stamp * 1e-9])).p_WB[0]
    assert np.linalg.norm(off) < 0.3 < np.sqrt(outcomes[-1].estimate.P[0, 0])


def test_a_start_that_fails_does_not_turn_the_heading():
    """0.6 s of a turn by 1 rad/s; the solver raises at ten frames of it."""
    vio, rng, frame = VisualInertialOdometry(VioConfig(), MOUNT), np.random.default_rng(0), 0.1
    vio.tracker = GivenTracks(lambda: (np.zeros(0, int), np.zeros((0, 2))))
    solve, calls = vio._motion_start.solve, []

    def failing(*arguments):
        calls.append(0)
        if 5 <= len(calls) < 15:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return solve(*arguments)

    vio._motion_start.solve = failing
    for k in range(400):
        vio.add_imu(ImuSample(2_000_000 * k, (0.0, 0.0, 1.0), tuple(rng.normal(0.0, 2.0, 3) + [0.0, 0.0, GRAVITY])))
        if 0.002 * k > frame + 0.02:
            try:
                vio.add_image(round((frame + MOUNT.stamp_offset) * 1e9), BLANK)
            except np.linalg.LinAlgError:
                pass
            frame += 1 / 30
    R_WB = vio._last_pose.present(np.zeros(3)).R_WB
    assert len(calls) > 15 and so3.log(R_WB)[2] == pytest.approx(frame - 1 / 30 - 0.1, abs=0.01)


def test_an_unknown_heading_does_not_end_the_filter():
    """At 2 m/s it makes the velocity in W unknown, but not that in B."""
    pose = replace(configured_pose(np.zeros(3), 0.0), covariance=np.diag([0.01, 0.01, 0.01, 3.0]))
    R_WB, v_WB = so3.exp(np.array([0.1, -0.2, 1.0])), np.array([1.2, -1.6, 0.3])
    state = initial_state(VioConfig(), MOUNT, 0, R_WB, pose, v_WB, np.zeros(3), 0.01, 0.01, 0.01)
    turns = -R_WB @ so3.hat(R_WB.T @ v_WB)  # v_W = R v_B: an error of the attitude turns the velocity
    state.P[at.VELOCITY], state.P[:, at.VELOCITY] = turns @ state.P[at.THETA], state.P[:, at.THETA] @ turns.T
    state.P[at.VELOCITY, at.VELOCITY] = turns @ state.P[at.THETA, at.THETA] @ turns.T + 0.01 * np.eye(3)
    assert np.sqrt(np.diag(state.P)[at.VELOCITY].max()) > 2.0 and velocity_sigma(state) == pytest.approx(0.1, rel=0.1)
    assert divergence(state, 20, 0, 15) == ""


SEEN, DARK = np.random.default_rng(5).uniform([40, 40], [600, 440], (60, 2)), np.zeros((0, 2))
NOSE = so3.exp(np.array([0.0, 1.4, 0.0]))


def unaccelerated(pixels, drift=0.0, R_WB=np.eye(3), has_flown=True, speed=None):
    """Outcomes of 1.2 s of a vehicle without acceleration, whose tracks, at these pixels, drift [px/s].

    Its filter has had no vision for half a second, with a velocity of 12 +- 3 cm/s, at a height above where it started; or, has it not
    flown, it starts there. Its rotors are reported to turn at a speed [rad/s].
    """
    rng, vio, out, frame = np.random.default_rng(3), VisualInertialOdometry(VioConfig(), MOUNT, floor=-0.04), [], 0.3
    vio.tracker = GivenTracks(lambda: (np.arange(len(pixels)), pixels + [drift * frame, 0.0]))
    noise = np.repeat([vio.config.imu.gyro_noise_density, vio.config.imu.accel_noise_density], 3) / np.sqrt(0.002)
    for k in range(750):
        read = noise * rng.normal(size=6) + np.r_[np.zeros(3), R_WB.T @ [0.0, 0.0, GRAVITY]]
        vio.add_imu(ImuSample(2_000_000 * k, tuple(read[:3]), tuple(read[3:])))
        if speed is not None:
            vio.add_rotors(RotorState(2_000_000 * k, (speed,) * 4, (0.0,) * 4))
        if k == 140 and has_flown:
            pose, v_WB = configured_pose(np.array([0.0, 0.0, 0.3]), 0.0), np.array([0.12, 0.0, 0.0])
            vio._begin(initial_state(vio.config, MOUNT, 280_000_000, R_WB, pose, v_WB, np.zeros(3), 0.005, 0.03, 0.001))
            vio._last_visual_update = 0
        if 0.002 * k > frame + 0.02:
            out.append(vio.add_image(round((frame + MOUNT.stamp_offset) * 1e9), BLANK).outcome)
            frame += 1 / 30
    return out


@pytest.mark.parametrize("rests, pixels, case", [
    (False, DARK, {}), (False, DARK, dict(R_WB=NOSE)), (True, DARK, dict(R_WB=NOSE, speed=0.0)), (True, DARK, dict(has_flown=False)),
    (False, DARK, dict(has_flown=False, speed=600.0)), (True, DARK, dict(speed=0.0)), (False, DARK, dict(speed=600.0)),
    (False, SEEN, dict(drift=2.5)), (False, SEEN, dict(drift=10.0, speed=0.0)), (True, SEEN, {})],
    ids=["dark", "x up", "on a wall", "not flown", "not flown, rotors turn", "landed", "flown", "static for a moment", "carried", "static"])
def test_a_quiet_imu_is_no_rest_where_it_may_be_a_hover(rests, pixels, case):
    """The noise of the sensor file includes the vibration of flight: a smooth hover is as quiet. The axes of B may be any IMU's."""
    assert (FrameOutcome.RESTING in unaccelerated(pixels, **case)) is rests


@pytest.mark.parametrize("drift, rests", [(0.0, True), (2.5, False)])
def test_after_images_were_missing_a_rest_is_one_in_the_image_for_long(drift, rests):
    """It may have left its place meanwhile, and hover; `drift` is that of the tracks [px/s]."""
    rng, vio, out, frame = np.random.default_rng(3), VisualInertialOdometry(VioConfig(), MOUNT, floor=-0.04), [], 0.3
    vio.tracker = GivenTracks(lambda: (np.arange(len(SEEN)), SEEN + [drift * max(frame - 7.0, 0.0), 0.0]))
    noise = np.repeat([vio.config.imu.gyro_noise_density, vio.config.imu.accel_noise_density], 3) / np.sqrt(0.002)
    for k in range(4200):
        read = noise * rng.normal(size=6) + [0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY]
        vio.add_imu(ImuSample(2_000_000 * k, tuple(read[:3]), tuple(read[3:])))
        if 0.002 * k > frame + 0.02:
            if not 0.8 < frame < 7.0:
                out.append((frame, vio.add_image(round((frame + MOUNT.stamp_offset) * 1e9), BLANK).outcome is FrameOutcome.RESTING))
            frame += 1 / 30
    assert any(resting for t, resting in out if t < 1.0) and any(resting for t, resting in out if t > 7.0) is rests


def after_loss(change=lambda state: None, drift=0.0, shake=1.0, image=BLANK, count=60, speed=None):
    """Results of 1.2 s after a loss in a hover of a filter whose state was changed; the IMU is quiet but for `shake` times its noise.

    The view drifts by `drift` [px/s], and the rotors are reported to turn at a speed [rad/s].
    """
    rng, vio, out, frame = np.random.default_rng(3), VisualInertialOdometry(VioConfig(), MOUNT), [], 0.3
    pixels, imu = rng.uniform([40, 40], [600, 440], (60, 2))[:count], VioConfig().imu
    vio.tracker = GivenTracks(lambda: (np.arange(count), pixels + [drift * frame, 0.0]))
    noise = shake * np.repeat([imu.gyro_noise_density, imu.accel_noise_density], 3) / np.sqrt(0.002)
    for k in range(750):
        read = noise * rng.normal(size=6) + [0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY]
        vio.add_imu(ImuSample(2_000_000 * k, tuple(read[:3]), tuple(read[3:])))
        if speed is not None:
            vio.add_rotors(RotorState(2_000_000 * k, (speed,) * 4, (0.0,) * 4))
        if k == 140:
            pose = configured_pose(np.zeros(3), 0.0)
            vio._begin(initial_state(vio.config, MOUNT, 280_000_000, np.eye(3), pose, np.zeros(3), np.zeros(3), 0.01, 0.05, 0.002))
            change(vio.filter.state)
            vio._drop_filter()
        if 0.002 * k > frame + 0.02:
            out.append(vio.add_image(round((frame + MOUNT.stamp_offset) * 1e9), image))
            frame += 1 / 30
    return vio, out


@pytest.mark.parametrize("speed, rests", [(None, False), (600.0, False), (0.0, True)])
def test_a_filter_lost_in_the_dark_starts_at_rest_only_where_the_rotors_stand(speed, rests):
    """After a landing without vision VIO goes on; in a hover it does not."""
    assert any(result.estimate is not None for result in after_loss(count=0, speed=speed)[1]) is rests


@pytest.mark.parametrize("drift, shake, rests", [(0.0, 1.0, True), (0.8, 5.0, False)])
def test_a_filter_lost_in_a_hover_that_looks_like_rest_does_not_start_at_rest(drift, shake, rests):
    """29 mm/s at 10 m: a static image excuses no vibration, as where the node was restarted."""
    assert any(result.outcome is FrameOutcome.RESTING for result in after_loss(drift=drift, shake=shake)[1]) is rests


@pytest.mark.parametrize("gyro_bias, accel_bias, begins_with", [(0.05, 0.8, 0.05), (0.5, 0.8, 0.0), (0.05, 1.6, 0.0)])
def test_biases_of_a_lost_filter_do_not_keep_a_standing_vehicle_from_its_start(gyro_bias, accel_bias, begins_with):
    """They are wrong by many of their standard deviations; those that no sensor has do not count in a start in motion either."""
    vio, out = after_loss(lambda state: (state.gyro_bias.__setitem__(0, gyro_bias), state.accel_bias.__setitem__(2, accel_bias)))
    assert out[-1].outcome is FrameOutcome.RESTING
    assert vio._motion_start._known_bias[0] == begins_with


def test_after_a_state_that_is_not_finite_the_pose_is_unknown():
    """Not the configured one, which the vehicle has left."""
    vio, out = after_loss(lambda state: (state.p_WB.__setitem__(0, 8.0), state.P.__setitem__((0, 0), np.nan)))
    assert out[-1].outcome is FrameOutcome.RESTING
    sigma = np.sqrt(np.diag(out[-1].estimate.pose_covariance))
    assert sigma[:3].min() > 100.0 and sigma[5] > 1.0


def test_a_hot_pixel_in_the_dark_is_no_frozen_camera():
    image = BLANK.copy()
    image[160, 160] = 40
    assert after_loss(image=image)[1][-1].outcome is FrameOutcome.RESTING
    image[:, ::224] = 40                                       # 7 % of it, as at night
    assert after_loss(image=image)[1][-1].outcome is FrameOutcome.REPEATED


@pytest.mark.parametrize("used, refused, lost", [(19, 24, False), (20, 81, True), (0, 21, True), (0, 20, False)])
def test_bad_tracks_alone_do_not_end_the_filter(used, refused, lost):
    """It is lost where it refuses nearly all that it sees."""
    state = initial_state(VioConfig(), MOUNT, 0, np.eye(3), configured_pose(np.zeros(3), 0.0), np.zeros(3), np.zeros(3), 0.01, 0.01, 0.01)
    assert bool(divergence(state, used, refused, 15)) is lost


@pytest.mark.parametrize("change, words", [
    (lambda s: s.v_WB.__setitem__(0, 40.0), "a speed of 40"), (lambda s: s.accel_bias.__setitem__(0, 6.0), "6.0 m/s^2")])
def test_a_state_that_cannot_be_is_noticed(change, words):
    seen = []

    def see(k):
        if len(seen) == 1:
            change(vio().filter.state)
        seen.append(k)
        rng = np.random.default_rng(k)
        return 60 * k + np.arange(60), rng.uniform([40, 40], [600, 440], (60, 2))

    made = []
    original = VisualInertialOdometry.__init__

    def vio():
        return made[0]

    def init(self, *args, **kwargs):
        original(self, *args, **kwargs)
        made.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(VisualInertialOdometry, "__init__", init)
        out = standing(see, 1.6, shake=0.3)
    assert any(words in r.message and r.outcome is FrameOutcome.LOST for _, r, _ in out)


@pytest.mark.slow
def test_drift_hardly_depends_on_the_rate_of_the_imu():
    """One second on the IMU alone, at 1000 Hz and at 100 Hz with means of ten samples: errors, and what the filter says of them."""
    config, ends, sigmas = VioConfig(), {1: [], 10: []}, {}
    imu = replace(VEHICLE.imu, rate=1000.0, accel_noise=config.imu.accel_noise_density * np.sqrt(1000.0),
                  gyro_noise=config.imu.gyro_noise_density * np.sqrt(1000.0), accel_bias_init=0.0, gyro_bias_init=0.0)
    for seed in range(15):
        times = 1.2 + 0.001 * np.arange(1001)
        m = PerchMotion(seed=seed).sample(times)
        read = read_imu(m, imu, np.random.default_rng(seed))
        for every in ends:
            buffer = ImuBuffer(config.imu, 5.0)
            for k in range(0, len(times), every):
                past = slice(max(0, k - every + 1), k + 1)
                sample = ImuSample(round(times[k] * 1e9), *(tuple(x[past].mean(axis=0)) for x in (read.gyro, read.accel)))
                assert buffer.add(sample) is ImuOutcome.USED
            start, end = round(times[0] * 1e9), round(times[-1] * 1e9)
            s = initial_state(config, MOUNT, start, m.R_WB[0], configured_pose(m.p_WB[0], 0.0), m.v_WB[0], np.zeros(3), 1e-6, 1e-6, 1e-6)
            Msckf(config, s, MOUNT.camera.fx).propagate(buffer.run(start, end), end)
            ends[every].append(m.p_WB[-1] - s.p_WB)
            sigmas[every] = np.sqrt(np.diag(s.P)[at.POSITION])
    drift = {every: np.sqrt(np.mean(np.square(e))) for every, e in ends.items()}
    assert drift[10] < 1.3 * drift[1]
    np.testing.assert_allclose(sigmas[10], sigmas[1], rtol=0.02)
