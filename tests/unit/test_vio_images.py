"""VIO on rendered images of a whole perch, and under every fault of camera and IMU."""

import functools
import tracemalloc
from collections import deque
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from closed_loop.branches import branched
from perch_core.camera import PinholeCamera
from perch_core.values import ImuSample
from perch_core.vehicle import load_vehicle
from open_loop import flight as flights
from open_loop.motion import Motion
from perch_perception.ukf import Health
from perch_perception.vio import FrameOutcome, VioConfig
from perch_perception.vio import tracker as tracking
from perch_perception.vio.drawing import TrackPainter
from perch_perception.vio.odometry import VisualInertialOdometry
from perch_perception.vio.tracker import Features, Tracker, _noise
from perch_sim.scenario import load_scenario

VEHICLE = load_vehicle("snapdragon")
BEFORE, HOVER = 3.2, 3.3  # the fault comes in the hover, and flights with one part from the others shortly before [s]


@functools.lru_cache(maxsize=1)
def flight():
    cv2.setNumThreads(1)
    return flights.fly(load_scenario("surface_90"), seed=3)


@functools.lru_cache(maxsize=1)
def climbed():
    """The loop of `flights.run_vio` and its vehicle, run up to `BEFORE`."""
    made = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "_run", lambda *loop_and_vehicle: made.append(loop_and_vehicle))
        flights.run_vio(flight())
    loop, vehicle = made[0]
    while vehicle.time < BEFORE * 1e9:
        loop.step()
    return loop, vehicle


def parted(changed):
    """As `flights.run_vio`, on a flight that is like the others up to `BEFORE`."""
    loop, vehicle = climbed()

    def flown():
        vehicle._frames = deque(frame for frame in changed.frames if frame[0] >= vehicle._frames[0][0])
        vehicle._flight = changed
        flights._run(loop, vehicle)
        return [flights.VioStep(middle, result, cost, flights._vio_error(changed, result)) for middle, result, cost in loop.components["vio"].frames]

    return branched(flown)


@functools.lru_cache(maxsize=1)
def undisturbed():
    return parted(flight())


def until(time):
    """The same flight, cut off."""
    whole = flight()
    n = int(np.searchsorted(whole.truth.times, time))
    truth = Motion(*(getattr(whole.truth, item.name)[:n] for item in fields(Motion)))
    return replace(whole, truth=truth, frames=tuple(f for f in whole.frames if f[0] < time - 0.03))


def position_sigma(step):
    return np.sqrt(np.diag(step.result.estimate.pose_covariance)[:3].max())


def assert_sane(steps):
    for step in steps:
        e = step.result.estimate
        if e is not None:
            assert np.isfinite(np.concatenate([e.p_WB, e.v_WB, e.R_WB.ravel(), e.pose_covariance.ravel()])).all()
            assert np.linalg.eigvalsh(e.pose_covariance)[0] > 0


# -- tracks --------------------------------------------------------------------------------------------------------------


def pulled():
    """How far tracks lie from where they should be, mean over them [px]: a faint texture moves under a lens that darkens."""
    rng, camera = np.random.default_rng(4), flight().mount.camera
    texture = cv2.GaussianBlur(rng.normal(0.0, 1.0, (camera.height + 200, camera.width + 200)), (0, 0), 4.0)
    texture *= 6.0 / texture.std()
    y, x = np.mgrid[:camera.height, :camera.width]
    vignette = 1.0 - 0.5 * ((x - camera.width / 2) ** 2 + (y - camera.height / 2) ** 2) / (camera.width / 2) ** 2
    tracker, first, shift = Tracker(VioConfig().tracker, camera), {}, 3
    for k in range(13):
        scene = 110.0 + texture[100:100 + camera.height, k * shift:k * shift + camera.width]
        image = np.clip(scene * vignette + rng.normal(0.0, 2.0, vignette.shape), 0, 255).astype(np.uint8)
        seen = tracker.track(image, np.eye(3))
        for i, pixel in zip(seen.ids, seen.pixels):
            first.setdefault(i, (k, pixel))
    moved = [pixel[0] - first[i][1][0] + (12 - first[i][0]) * shift for i, pixel in zip(seen.ids, seen.pixels) if first[i][0] == 0]
    assert len(moved) > 20
    return float(np.mean(moved))


def test_vignetting_does_not_hold_the_tracks_back(monkeypatch):
    """It stands still in the image, and what stands still pulls. Followed from frame to frame, each of which is the reference."""
    monkeypatch.setattr(tracking, "_REFERENCE_CHANGE", 0.0)
    assert abs(pulled()) < 0.2
    monkeypatch.setattr(tracking, "flattened", lambda image: image)
    assert pulled() > 0.5


def test_a_blurred_patch_is_known_less_well_than_a_sharp_one(monkeypatch):
    """Foerstner: sigma_n^2 over the least eigenvalue of sum g g^T, with g of the scene without its noise; `track` is the least."""
    rng, camera = np.random.default_rng(5), VEHICLE.mounts["down"].camera
    noise, texture = rng.normal(0.0, 2.0, (camera.height, camera.width)), rng.normal(0.0, 1.0, (camera.height, camera.width))
    vio, median = VisualInertialOdometry(VioConfig(), VEHICLE.mounts["down"], np.zeros(3)), []
    monkeypatch.setattr(tracking, "_NOISE_FACTOR", 0.0)
    monkeypatch.setattr(tracking, "flattened", lambda image: image)
    window = tracking._WINDOW
    for blur, contrast in ((2.0, 30.0), (6.0, 3.0)):
        smooth = cv2.GaussianBlur(texture, (0, 0), blur)
        scene = (128.0 + smooth * contrast / smooth.std()).astype(np.float32)
        image = np.clip(np.rint(scene + noise), 0, 255).astype(np.uint8)
        features = Tracker(vio.config.tracker, camera).track(image, np.eye(3))
        assert len(features.ids) > 20
        exact = []
        for x, y in features.pixels:
            patch = cv2.getRectSubPix(scene, (window + 2, window + 2), (float(x), float(y))).astype(float)
            g = np.stack([cv2.Scharr(patch, cv2.CV_64F, 1, 0), cv2.Scharr(patch, cv2.CV_64F, 0, 1)])[:, 1:-1, 1:-1].reshape(2, -1) / 32.0
            exact.append(_noise(image) / np.sqrt(np.linalg.eigvalsh(g @ g.T)[0]))
        assert np.median(features.sigma / exact) == pytest.approx(1.0, rel=0.1)
        if blur == 2.0:  # of a blurred patch the noise's scatter leaves less
            np.testing.assert_allclose(features.sigma, exact, rtol=0.1)
        median.append(np.median(vio._observe(features).noise))
    assert median[0] == 1.0 < median[1]


@pytest.mark.parametrize("level", [-20.0, 275.0, 128.0])
def test_where_most_pixels_are_black_or_white_the_noise_is_that_of_the_others(level):
    rng = np.random.default_rng(6)
    scene = np.full((480, 640), level) + np.linspace(-1.0, 1.0, 640) * (150.0 if level != 128.0 else 0.0)
    clipped = np.clip(np.rint(scene + rng.normal(0.0, 3.0, scene.shape)), 0, 255).astype(np.uint8)
    assert _noise(clipped) == pytest.approx(3.0, rel=0.15)
    assert _noise(tracking.flattened(clipped), clipped) == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize("level", [0, 110, 255])
def test_an_image_without_noise_has_that_of_its_rounding(level):
    """Synthetic, compressed, or saturated: no feature is exact."""
    camera, image = VEHICLE.mounts["down"].camera, np.full((480, 640), level, np.uint8)
    assert _noise(image) == pytest.approx(np.sqrt(1.0 / 12.0))
    for x in range(60, 600, 60):
        cv2.rectangle(image, (x, 200), (x + 30, 230), 200 if level < 200 else 50, -1)
    features = Tracker(VioConfig().tracker, camera).track(image, np.eye(3))
    assert len(features.ids) > 10 and features.sigma.min() > 1e-4


def test_the_tracker_of_a_large_camera_takes_little_memory():
    tracemalloc.start()
    Tracker(VioConfig().tracker, PinholeCamera(4000, 3000, 3000.0, 3000.0, 1999.5, 1499.5))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


# -- the whole perch -----------------------------------------------------------------------------------------------------


def test_from_the_ground_to_the_wall():
    steps = undisturbed()
    assert_sane(steps)
    outcomes = [s.result.outcome for s in steps]
    assert FrameOutcome.RESTING in outcomes[:20]
    assert outcomes[-1] is FrameOutcome.TRACKING
    # the pose goes on all the time, and what flies is not taken for standing
    posed = outcomes[outcomes.index(FrameOutcome.RESTING):]
    assert set(posed) <= {FrameOutcome.RESTING, FrameOutcome.LEAVING, FrameOutcome.TRACKING}
    lift_off = flight().motion.settings.ground + 0.35
    assert all(s.result.outcome is not FrameOutcome.RESTING for s in steps if s.time > lift_off)
    errors = np.array([s.error for s in steps if s.error is not None and s.time > flight().motion.perch_time])
    assert np.sqrt((errors[:, :3] ** 2).mean(axis=0)).max() < 0.03
    assert np.degrees(np.linalg.norm(errors[-1, 3:6])) < 1.5
    assert steps[-1].result.restarts == 0


def test_the_ground_tells_nothing_and_breaks_nothing():
    """2 cm above the floor the image is a blur: no feature is made of noise, and the pose stays where VIO was told that it is.

    To what the IMU makes of the last 0.25 s, 1.1 mm an axis at 1 sigma.
    """
    ground = [s for s in undisturbed() if 0.5 < s.time < 1.0]
    assert len(ground) > 10
    for step in ground:
        assert step.result.features < 10
        assert np.linalg.norm(step.error[:3] + flight().start_error[:3]) < 5e-3
    assert np.linalg.norm(np.mean([step.error[:3] for step in ground], axis=0) + flight().start_error[:3]) < 2e-3


def test_starts_in_motion():
    """Switched on in the middle of the climb: gravity, velocity and scale come from half a second of images."""
    steps = flights.run_vio(until(3.6), begin=1.9)
    started = [s for s in steps if s.result.estimate is not None]
    assert started and started[0].time < 2.9
    assert steps[0].result.outcome is FrameOutcome.INITIALISING
    # what it says of velocity at once, and of motion since: where it began in the map nobody could tell it
    assert np.linalg.norm(started[0].error[6:9]) < 0.25
    drift = started[-1].error[:3] - started[0].error[:3]
    assert np.linalg.norm(drift) < 0.12
    assert_sane(steps)


# -- faults --------------------------------------------------------------------------------------------------------------

def tampered(flight, frames=lambda t, stamp, image: [(stamp, image)], imu=lambda t, sample: sample):
    """A flight with other frames, at a time [s] none, one or several (stamp [ns], image), and with other IMU samples or none."""
    samples = [imu(float(t), flight.sample(k)) for k, t in enumerate(flight.truth.times)]
    kept = [k for k, sample in enumerate(samples) if sample is not None]
    gyro, accel = (np.array([getattr(samples[k], name) for k in kept]) for name in ("w_B", "f_B"))
    truth = Motion(*(getattr(flight.truth, item.name)[kept] for item in fields(Motion)))
    return replace(flight, frames=tuple((t, *one) for t, stamp, image in flight.frames for one in frames(t, stamp, image)), truth=truth,
                   readings=replace(flight.readings, gyro=gyro, accel=accel, gyro_bias=flight.readings.gyro_bias[kept],
                                    accel_bias=flight.readings.accel_bias[kept]))


def test_a_covered_camera_is_reported_and_survived():
    cover = (HOVER, HOVER + 0.5)
    steps = parted(tampered(until(4.5), lambda t, stamp, image: [
        (stamp, np.full_like(image, 3) if cover[0] <= t < cover[1] else image)], lambda t, sample: (
        sample._replace(w_B=(sample.w_B[0] + 0.05 * np.sin(180.0 * t), *sample.w_B[1:])) if HOVER <= t < cover[1] else sample)))  # rotors shake
    assert_sane(steps)
    inside = [s for s in steps if cover[0] + 0.2 < s.time < cover[1]]
    assert inside and all(s.result.outcome is FrameOutcome.BLIND and s.result.estimate is None for s in inside)
    assert inside[-1].result.blind_for > 0.3
    before = next(s for s in reversed(steps) if s.time < cover[0])
    after = next(s for s in steps if s.time > cover[1] and s.result.outcome is FrameOutcome.TRACKING)  # as soon as new tracks tell something
    assert after.time < cover[1] + 0.8
    alone = VioConfig().imu.accel_noise_density**2 * (cover[1] - cover[0]) ** 3 / 3  # the IMU's noise, integrated twice
    assert position_sigma(after) ** 2 > position_sigma(before) ** 2 + alone
    last = steps[-1]
    assert np.linalg.norm(last.error[:3]) < max(0.08, 4 * position_sigma(last))
    assert last.result.restarts == 0
    # the estimator coasts meanwhile and says so
    track = flights.run_estimator(until(4.45), steps)
    healths = {round(health.stamp * 1e-9, 1): Health(health.state) for health in track.health}
    assert healths[3.2] is Health.RUNNING and healths[3.7] is Health.COASTING and healths[4.3] is Health.RUNNING


def test_a_blurred_frame_does_no_harm():
    blurred = []

    def tamper(t, stamp, image):
        if HOVER <= t < HOVER + 0.04:
            blurred.append(stamp)
            image = cv2.GaussianBlur(image, (0, 0), 12.0)
        return [(stamp, image)]

    steps = parted(tampered(until(4.2), tamper))
    assert blurred
    assert_sane(steps)
    clean = {s.time: s for s in undisturbed()}
    assert steps[-1].result.outcome is FrameOutcome.TRACKING
    assert np.linalg.norm(steps[-1].error[:3] - clean[steps[-1].time].error[:3]) < 0.04
    assert position_sigma(steps[-1]) >= position_sigma(clean[steps[-1].time])


def test_dropped_frames_cost_little():
    counter = iter(range(10_000))
    steps = flights.run_vio(tampered(until(4.5), lambda t, stamp, image: [] if next(counter) % 3 == 0 else [(stamp, image)]))
    assert_sane(steps)
    assert steps[-1].result.outcome is FrameOutcome.TRACKING
    assert np.linalg.norm(steps[-1].error[:3]) < 0.08


def test_duplicated_and_disordered_frames_are_refused_and_change_nothing():
    """The same frames give the same bits."""
    short = until(2.6)
    previous = []

    def tamper(t, stamp, image):
        previous.append((stamp, image))
        old = [previous[-4]] if len(previous) > 4 else []
        return [(stamp, image), (stamp, image), *old]

    steps = flights.run_vio(tampered(short, tamper))
    refused = [s for s in steps if s.result.outcome is FrameOutcome.NOT_NEWER]
    assert len(refused) > len(short.frames)
    assert all("not newer" in s.result.message for s in refused)
    kept = [s for s in steps if s.result.outcome is not FrameOutcome.NOT_NEWER]
    assert len(kept) == len(short.frames)
    places, others = ([step.result.estimate and step.result.estimate.p_WB.tobytes() for step in some] for some in (kept, undisturbed()[:len(kept)]))
    assert places == others and sum(place is not None for place in places) > 20


def test_a_future_stamp_is_refused():
    steps = flights.run_vio(tampered(until(1.5), lambda t, stamp, image: [(stamp + 3_000_000_000, image), (stamp, image)]))
    assert {s.result.outcome for s in steps[::2]} == {FrameOutcome.FUTURE}
    assert steps[-1].result.estimate is not None


@pytest.mark.parametrize("image", [np.zeros((240, 320), np.uint8), np.zeros((480, 640, 3), np.uint8),
                                   np.zeros((480, 640), np.float32)])
def test_an_image_of_another_kind_is_refused(image):
    steps = flights.run_vio(tampered(until(1.2), lambda t, stamp, _: [(stamp, image)]))
    assert {s.result.outcome for s in steps} == {FrameOutcome.BAD_IMAGE}


def nan_gyro(sample):
    return sample._replace(w_B=(float("nan"), 0.0, 0.0))


def saturated(sample):
    return sample._replace(f_B=(sample.f_B[0], sample.f_B[1], 156.0))


@pytest.mark.parametrize(("fault", "length"), [(lambda s: None, 0.03), (nan_gyro, 0.01), (saturated, 0.004)],
                         ids=["gap", "nan", "saturated"])
def test_imu_faults_leave_a_finite_estimate_with_a_larger_covariance(fault, length):
    def tamper_imu(t: float, sample: ImuSample):
        return fault(sample) if HOVER <= t < HOVER + length else sample

    steps = parted(tampered(until(4.2), imu=tamper_imu))
    assert_sane(steps)
    clean = {s.time: s for s in undisturbed()}
    hit = next(s for s in steps if s.time > HOVER + length and s.result.estimate is not None)
    good = clean[hit.time].result.estimate
    assert np.linalg.det(hit.result.estimate.velocity_covariance) > 1.2 * np.linalg.det(good.velocity_covariance)
    assert steps[-1].result.outcome is FrameOutcome.TRACKING
    assert np.linalg.norm(steps[-1].error[:3]) < 0.15


def test_a_lost_filter_says_so_and_starts_again_in_motion(monkeypatch):
    """Blind for so long that velocity is unknown (the bound is lowered for the test): lost, then found by motion."""
    monkeypatch.setattr("perch_perception.vio.divergence._MAX_VELOCITY_SIGMA", 0.03)
    cover = (1.9, 2.6)
    steps = flights.run_vio(tampered(until(4.4), lambda t, stamp, image: [
        (stamp, np.full_like(image, 3) if cover[0] <= t < cover[1] else image)]))
    assert_sane(steps)
    lost = next(s for s in steps if s.result.outcome is FrameOutcome.LOST)
    assert "velocity" in lost.result.message and lost.result.estimate is None
    assert steps[-1].result.restarts >= 1
    again = [s for s in steps if s.time > lost.time and s.result.estimate is not None]
    assert again, "it never started again"
    # the position has gone on with the IMU meanwhile, and the covariance has the gap in it
    assert np.linalg.norm(again[0].error[:3]) < 4 * position_sigma(again[0]) < 0.2


# -- tracker and drawing -------------------------------------------------------------------------------------------------


def test_noise_makes_no_features():
    rng, mount = np.random.default_rng(0), flight().mount
    for sigma in (2.0, 5.0, 9.0):
        noise = np.clip(rng.normal(110, sigma, (480, 640)), 0, 255).astype(np.uint8)
        assert len(Tracker(VioConfig().tracker, mount.camera).track(noise, np.eye(3)).ids) < 10


def test_tracks_stay_on_their_points():
    """Tracks through the hover against the projection of the floor points they began on: no drift beyond 0.3 px RMS at any time."""
    whole = flight()
    tracker, points, last, errors = Tracker(VioConfig().tracker, whole.mount.camera), {}, None, []
    frames = [f for f in whole.frames if 3.0 < f[0] < 4.2]
    for time, _, image in frames:
        m = whole.motion.sample(np.array([time]))
        p_WC, R_WC = whole.mount.pose(m.p_WB[0], m.R_WB[0])
        features = tracker.track(image, np.eye(3) if last is None else R_WC.T @ last)
        last = R_WC
        rays = whole.mount.camera.unproject(features.pixels) @ R_WC.T
        if not points:
            points = {i: p_WC - d * p_WC[2] / d[2] for i, d in zip(features.ids.tolist(), rays) if d[2] < -0.3}
        kept = [k for k, i in enumerate(features.ids.tolist()) if i in points]
        expected, _ = whole.mount.camera.project((np.array([points[features.ids[k]] for k in kept]) - p_WC) @ R_WC)
        errors.append(features.pixels[kept] - expected)
    assert len(errors[-1]) > 0.7 * len(points)
    # the calibration of the true lens differs by 0.3 %: what all points share is not the tracker's, as far as that reaches
    shared = np.array([error.mean(axis=0) for error in errors])
    assert max(np.sqrt(((error - mean) ** 2).sum(axis=1).mean()) for error, mean in zip(errors, shared)) < 0.3
    assert np.linalg.norm(shared, axis=1).max() < 0.4


def test_the_debug_image_shows_the_features():
    painter, image = TrackPainter(), np.full((480, 640), 100, np.uint8)
    for shift in range(3):
        features = Features(np.array([1, 2]), np.array([[100.0 + 5 * shift, 200.0], [300.0, 220.0]]), 0, np.zeros(2))
        drawn = painter.paint(image, features, {2}, "caption")
    assert drawn.shape == (480, 640, 3)
    assert tuple(drawn[217, 300]) == (0, 220, 0)     # landmark: green
    assert tuple(drawn[200, 105]) == (0, 200, 255)   # the way the other came: yellow
