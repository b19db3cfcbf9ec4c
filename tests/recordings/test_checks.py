"""`scripts/sensors.py check`: what would make perception fail is named, and what is well is not."""

import itertools
import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from perch_core.sensors import CameraSensor, ImuSensor, Sensors, load_sensors
from perch_core.values import CameraImage
from perch_eval.recordings import check as checks
from perch_eval.recordings import sensors_command
from perch_eval.recordings.check import check
from perch_eval.recordings.imu_check import Report, allan_deviation, check_estimated_biases, check_imu, check_rate, stretches_at_rest
from perch_eval.recordings.opening import BagRecording, open_recording
from perch_eval.recordings.recording import IMU, Recording, RecordingError
from perch_eval.recordings.trajectory import Trajectory, evaluate, read_trajectory, write_tum
from recordings import photo_flight


@pytest.fixture(scope="module")
def heard(files):
    """The events of the bag with compressed images, and its sensors."""
    sensors = load_sensors(files / "mine.yaml")
    return list(open_recording(files / "sqlite3", sensors).events()), sensors


class Told(Recording):
    """Events that are at hand."""

    def __init__(self, events, sensors):
        super().__init__("told", sensors)
        self._events = events
        self.images = {"cam0": sum(e.source != IMU for e in events)}
        self.samples = sum(e.source == IMU for e in events)

    def events(self):
        yield from self._events


@pytest.fixture(autouse=True)
def few_looks(monkeypatch):
    """A dozen images and four seconds of turns are enough here."""
    monkeypatch.setattr(checks, "SAMPLED_IMAGES", 12)
    monkeypatch.setattr(checks, "SPAN", 4.0)


def spoilt(heard, imu=lambda k, s: s, image=lambda k, i: i):
    """The findings that are not `ok`, as {about: level}, of changed events; None: it is lost."""
    events, sensors = heard
    out, counts = [], {True: 0, False: 0}
    for event in events:
        felt = event.source == IMU
        value = (imu if felt else image)(counts[felt], event.value)
        counts[felt] += 1
        if value is not None:
            out.append(event._replace(value=value))
    report = check(Told(out, sensors))
    return {f.about: f.level for f in report.findings if f.level != "ok"}


def pixels(change):
    return lambda k, i: CameraImage(i.stamp, i.frame, i.width, i.height, i.encoding, change(i.pixels()))


def times(factor):
    return lambda k, s: s._replace(f_B=tuple(factor * x for x in s.f_B))


def test_nothing_is_wrong_with_a_good_one(heard):
    assert spoilt(heard) == {}


@pytest.mark.parametrize("change, about, level", [
    (times(1 / 9.81), "imu units", "fails"),
    (times(0.0), "imu units", "fails"),
    (lambda k, s: s._replace(w_B=(3000.0, 0.0, 40.0)), "imu units", "fails"),
    (lambda k, s: s._replace(w_B=(np.nan, 0.0, 0.0)) if k % 100 == 0 else s, "imu values", "fails"),
    (lambda k, s: None if 500 < k < 530 else s, "imu gaps", "warning"),
    (lambda k, s: s._replace(stamp=s.stamp - 4_500_000 * (k % 2)), "imu jitter", "warning"),
    (lambda k, s: s if k % 5 == 0 else None, "imu rate", "fails"),
])
def test_what_is_wrong_with_an_imu_is_named(heard, change, about, level):
    """Judged without the images, whose evaluation takes half a second."""
    assert spoilt(heard, change, lambda k, image: None).get(about) == level


@pytest.mark.parametrize("changes, about, level", [
    (dict(imu=lambda k, s: s._replace(stamp=s.stamp + 3600 * 10**9)), "camera cam0 clock", "fails"),
    (dict(image=lambda k, i: CameraImage(i.stamp + 60_000_000, i.frame, i.width, i.height, i.encoding, i.pixels())),
     "camera cam0 clock", "fails"),
    (dict(image=pixels(lambda p: p // 40)), "camera cam0 exposure", "fails"),
    (dict(image=pixels(lambda p: np.full_like(p, 128))), "camera cam0 texture", "fails"),
    (dict(image=pixels(lambda p: p[::2, ::2])), "camera cam0", "fails"),
    (dict(image=lambda k, i: None if k % 8 else i), "camera cam0 rate", "fails"),
])
def test_what_is_wrong_is_named(heard, changes, about, level):
    assert spoilt(heard, **changes).get(about) == level


def test_blur_is_seen(heard):
    found = spoilt(heard, image=pixels(lambda p: cv2.GaussianBlur(p, (0, 0), 4.0)))
    assert found.get("camera cam0 sharpness") == "warning"


@pytest.mark.parametrize("late, R, size, level, words", [
    (0.0, np.eye(3), 1.0, "ok", "stamps are +0 ms"), (0.15, np.eye(3), 1.0, "fails", "stamps are +150 ms"),
    (-0.4, np.eye(3), 1.0, "fails", "stamps are -400 ms"), (9.0, np.eye(3), 1.0, "fails", "does not match the gyro's at any offset"),
    (0.0, np.eye(3), 0.005, "warning", "not checked: rotation is too slow"),
    (0.0, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), 1.0, "ok", "stamps are +0 ms")])
def test_clock_and_mounting_are_told_by_the_turns(late, R, size, level, words):
    rng, t = np.random.default_rng(7), np.arange(0.0, 30.0, 0.005)
    smooth = np.exp(-0.5 * (np.arange(-120, 121) / 30.0) ** 2)
    gyro = size * np.stack([np.convolve(rng.standard_normal(len(t)), smooth / np.linalg.norm(smooth), "same") for _ in range(3)], axis=1)
    begin = np.arange(10.0, 18.0, 0.05)
    seen = np.array([gyro[(t > b - 0.001) & (t < b + 0.051)].mean(axis=0) for b in begin]) @ R + 0.02 * rng.standard_normal((len(begin), 3))
    report = Report()
    checks._check_clock(report, "cam0", np.column_stack([begin + late, begin + late + 0.05, seen]), t, gyro, 0.0)
    found = {f.about: f for f in report.findings}
    assert found["camera cam0 clock"].level == level and words in found["camera cam0 clock"].text
    if late < 9.0 and size == 1.0:
        turned = (R != np.eye(3)).any()
        assert float(found["camera cam0 mounting"].text.split()[0]) == pytest.approx(90.0 if turned else 0.0, abs=1.0)
        assert found["camera cam0 mounting"].level == ("fails" if turned else "ok")


@pytest.mark.parametrize("factor, matches", [(1.6, True), (57.3, False)], ids=["close scene", "deg/s"])
def test_a_close_scene_changes_the_size_of_the_turns_and_no_more(factor, matches):
    """Translation adds to what looks like a turn: correlated with the gyro's, larger, and noisy."""
    rng, t = np.random.default_rng(7), np.arange(0.0, 30.0, 0.005)
    gyro = 0.4 * np.stack([np.sin(2.0 * t), np.cos(3.0 * t), 0.2 * np.sin(t)], axis=1)
    begin = np.arange(10.0, 18.0, 0.05)
    seen = np.array([gyro[(t > b - 0.001) & (t < b + 0.051)].mean(axis=0) for b in begin])
    report = Report()
    checks._check_clock(report, "cam0", np.column_stack([begin, begin + 0.05, factor * seen + 0.25 * rng.standard_normal(seen.shape)]),
                              t, gyro, 0.0)
    text = next(f.text for f in report.findings if f.about == "camera cam0 clock")
    assert ("does not match" not in text) == matches, text


def test_translation_close_to_the_floor_widens_the_sigma_of_the_clock(heard, monkeypatch):
    """It looks like turns and shifts the estimate by 10 ms; neighbouring errors that are alike show it."""
    monkeypatch.setattr(checks, "SPAN", 8.0)
    events, sensors = heard
    report = check(Told(events, sensors))
    text = next(f.text for f in report.findings if f.about == "camera cam0 clock")
    sigma = 1e-3 * float(text.split("(")[1].split(" ms")[0])
    assert abs(report.figures["cam0_stamp_offset_s"] - photo_flight.STAMP_OFFSET) < 1.5 * sigma < 0.02


@pytest.mark.parametrize("rate, level", [(100.0, "ok"), (99.99, "ok"), (99.5, "ok"), (98.0, "warning"), (49.9, "warning"), (48.0, "fails")])
def test_a_rate_as_recommended_is_well_whatever_the_clocks(rate, level):
    report = Report()
    check_rate(report, "imu", np.rint(1e9 / rate * np.arange(1000)).astype(np.int64), minimum=50.0, recommended=100.0, nominal=None)
    assert report.findings[0].level == level


def test_the_command_says_it_by_its_exit_code(files, tmp_path, capsys):
    assert sensors_command.main(["check", str(files / "mcap"), "--sensors", str(files / "mine.yaml")]) == 0
    told = capsys.readouterr().out
    assert "rest" in told and "gyro noise" in told and "warning" not in told and "fails" not in told
    (tmp_path / "cam0" / "data").mkdir(parents=True)
    (tmp_path / "cam0" / "data.csv").write_text("".join(f"{10**9 + 10**8 * k},{k}.png\n" for k in range(12)))
    for k in range(12):
        cv2.imwrite(str(tmp_path / "cam0" / "data" / f"{k}.png"), np.full((48, 64), 128, np.uint8))
    assert sensors_command.main(["check", str(tmp_path)]) == 1
    assert re.search(r"^fails +camera cam0 texture ", capsys.readouterr().out, re.MULTILINE)
    assert sensors_command.main(["check", str(files / "none")]) == 2


def test_allan_deviation_finds_the_density_and_the_walk():
    rng, rate = np.random.default_rng(3), 200.0
    white = 0.01 * np.sqrt(rate) * rng.standard_normal((40_000, 2))
    tau, deviation = allan_deviation(white, rate)
    np.testing.assert_allclose((deviation * np.sqrt(tau)[:, None])[:8], 0.01, rtol=0.05)  # sigma = N / sqrt(tau)
    walk = np.cumsum(0.002 * np.sqrt(1 / rate) * rng.standard_normal((40_000, 2)), axis=0)
    tau, deviation = allan_deviation(walk, rate)
    np.testing.assert_allclose((deviation / np.sqrt(tau / 3.0)[:, None])[4:9], 0.002, rtol=0.25)  # sigma = K sqrt(tau / 3)


@pytest.mark.parametrize("bias", [0.0, 0.2])
def test_rest_is_seen_whatever_the_bias(bias):
    rng, t = np.random.default_rng(4), np.arange(0.0, 6.0, 0.005)
    imu = np.hstack([np.full((len(t), 3), bias), np.tile([1.0, 0.0, 9.8], (len(t), 1))]) + 0.02 * rng.standard_normal((len(t), 6))
    imu[t > 3.0, 0] += 0.3 * np.sin(5.0 * t[t > 3.0])
    first, last = stretches_at_rest((1e9 * t).astype(np.int64), imu)[0]
    assert first == 0 and 2.7 < t[last] < 3.3


def findings(stamps, still, sensor=None, off=np.zeros(6)):
    """{about: finding} of an IMU that turns where it is not still, and whose readings are off by `off`."""
    t = 0.005 * np.arange(len(still))
    imu = np.hstack([np.where(still, 0.0, np.sin(5.0 * t))[:, None] * (1.0, 0.0, 0.0), np.tile([0.0, 0.0, 9.81], (len(t), 1))]) + off
    report = Report()
    check_imu(report, stamps, imu + 0.01 * np.random.default_rng(8).standard_normal(imu.shape), sensor)
    return {finding.about: finding for finding in report.findings}


def test_an_impact_that_fades_out_in_the_first_window_of_a_rest_is_no_noise():
    """As that of a perch: a turn of 0.25 rad/s that swings, and falls to 1/e in 60 ms."""
    t = 0.005 * np.arange(441)
    density = 0.01 / np.sqrt(200.0)  # of the white noise of `findings`
    sensor = ImuSensor(rate=200.0, accel_noise_density=density, gyro_noise_density=density, accel_bias_walk=0.002, gyro_bias_walk=2e-4,
                       accel_bias=0.1, gyro_bias=0.02)
    impact = np.zeros((len(t), 6))
    impact[t >= 1.0, 1] = 0.25 * np.exp(-(t[t >= 1.0] - 1.0) / 0.06) * np.cos(40.0 * (t[t >= 1.0] - 1.0))
    found = findings((1e9 * t).astype(np.int64), t >= 1.0, sensor, impact)
    assert "still for 1.0 s from 1.0 s on" in found["rest"].text and found["gyro noise"].level == "ok"


def test_the_allan_deviation_at_rest_is_among_the_figures():
    report, white = Report(), 0.01 * np.random.default_rng(8).standard_normal((2000, 6))
    check_imu(report, 5_000_000 * np.arange(2000), white + (0.0, 0.0, 0.0, 0.0, 0.0, 9.81), None)
    tau, gyro = np.array(report.figures["allan_tau_s"]), np.array(report.figures["allan_gyro"])
    assert tau[-1] > 1.0 and len(report.figures["allan_accel"]) == len(tau)
    assert gyro[0] * np.sqrt(tau[0]) == pytest.approx(0.01 / np.sqrt(200.0), rel=0.1)


def test_rest_at_the_start_counts_though_another_is_longer():
    t = 0.005 * np.arange(2200)
    stamps = (1e9 * t).astype(np.int64)
    rest = findings(stamps, (t < 2.0) | (t > 7.0))["rest"]
    assert rest.level == "ok" and "from 7.0 s on, for 2.0 s at the start" in rest.text
    assert findings(stamps, t > 7.0)["rest"].level == "warning"


@pytest.mark.parametrize("axis, bias, about, level", [
    (5, 0.25, "accel bias", "ok"), (5, -0.25, "accel bias", "ok"), (5, 0.35, "accel bias", "warning"), (5, -0.35, "accel bias", "warning"),
    (3, 0.35, "accel bias", "ok"),  # across gravity a bias looks like a tilt
    (1, 0.05, "gyro bias", "ok"), (1, -0.07, "gyro bias", "warning"), (2, 0.07, "gyro bias", "warning")])
def test_means_at_rest_are_within_three_sigma_of_the_turn_on_bias(axis, bias, about, level):
    sensor = ImuSensor(rate=200.0, accel_noise_density=0.01, gyro_noise_density=0.01, accel_bias_walk=0.002, gyro_bias_walk=2e-4,
                       accel_bias=0.1, gyro_bias=0.02)
    found = findings(5_000_000 * np.arange(1000), np.full(1000, True), sensor, bias * np.eye(6)[axis])
    assert found[about].level == level and ("3 sigma of the sensor file" in found[about].text) == (level == "warning")
    assert found["imu rate"].level == "ok" and "imu units" not in found
    assert all(f.level == "ok" for name, f in found.items() if name != about)


@pytest.mark.parametrize("accel, gyro, warned", [(0.29, 0.05, []), (-0.31, 0.05, ["accel_bias"]), (0.1, -0.07, ["gyro_bias"])])
def test_estimated_biases_beyond_three_sigma_are_to_be_declared(accel, gyro, warned):
    """The greatest on any axis at any time, also where a later one is smaller."""
    sensor = ImuSensor(rate=200.0, accel_noise_density=0.01, gyro_noise_density=0.01, accel_bias_walk=0.002, gyro_bias_walk=2e-4,
                       accel_bias=0.1, gyro_bias=0.02)
    states = [SimpleNamespace(gyro_bias=(0.0, share * gyro, 0.0), accel_bias=(0.0, 0.0, share * accel)) for share in (0.2, 1.0, 0.5)]
    report = Report()
    check_estimated_biases(report, states, sensor)
    assert [name for f in report.findings if f.level == "warning" for name in ("accel_bias", "gyro_bias") if f"declare {name} in the" in f.text] == warned
    assert len(report.findings) == 2 and report.figures["accel_bias_sigmas"] == pytest.approx(abs(accel) / 0.1)


def test_stamps_that_are_none_fail():
    still, stamps = np.full(1000, True), 5_000_000 * np.arange(1000)
    assert "does not stamp" in findings(0 * stamps, still)["imu stamps"].text and findings(0 * stamps, still)["imu stamps"].level == "fails"
    assert findings(stamps // 1000, still)["imu rate"].level == "fails"
    assert "not judged" in findings(stamps // 20_000_000 * 20_000_000, still)["noise"].text
    report = Report()
    statistics = checks.ImageStatistics(20)
    for _ in range(20):
        statistics.add(CameraImage(0, "c", 64, 48, "mono8", np.zeros((48, 64), np.uint8)))
    checks.check_camera(report, "cam0", statistics, stamps, None)
    assert any("does not stamp" in finding.text for finding in report.findings)


def test_messages_that_cannot_be_used_are_counted_whatever_the_reasons_quote(files, monkeypatch):
    recording, convert, sizes = open_recording(files / "sqlite3", load_sensors(files / "mine.yaml")), BagRecording._value, itertools.count()

    def value(self, source, connection, message):
        if source != IMU:
            raise RecordingError(f"compressed image: {next(sizes)} bytes are no JPEG")
        return convert(self, source, connection, message)

    monkeypatch.setattr(BagRecording, "_value", value)
    assert len(list(recording.events())) == recording.samples
    n = recording.images["cam0"]
    assert n > 50 and recording.damage.startswith(f"{n} of {n} messages of ") and "are no JPEG" in recording.damage


def test_image_files_that_are_missing_or_damaged_are_counted(tmp_path):
    data = tmp_path / "cam0" / "data"
    data.mkdir(parents=True)
    (tmp_path / "cam0" / "data.csv").write_text("".join(f"{10**9 + 10**8 * k},{k}.png\n" for k in range(12)))
    for k in range(12):
        cv2.imwrite(str(data / f"{k}.png"), np.full((48, 64), 9 * k, np.uint8))
    (data / "3.png").unlink()
    (data / "5.png").write_bytes(b"broken off")
    sensors = Sensors(name="mine", cameras={"cam0": CameraSensor(model="pinhole", width=64, height=48, focal=(60.0, 60.0), centre=(32.0, 24.0))})
    for calibration, count in ((None, 2), (sensors, 1)):
        found = {f.about: f for f in check(open_recording(tmp_path, calibration)).findings}
        assert f"{count} of 12 image files are missing" in found["recording"].text and found["recording"].level == "warning"
        assert found["recording"].text.endswith("3.png")
    assert found["camera cam0 files"] == ("warning", "camera cam0 files", "1 of 11 sampled images could not be decoded")


@pytest.mark.parametrize("stamp", ["now", "\u00b2", "9" * 19, "9" * 5000], ids=["word", "square", "beyond int64", "endless"])
def test_stamps_of_images_that_are_no_nanoseconds_are_refused(tmp_path, stamp):
    (tmp_path / "cam0").mkdir()
    (tmp_path / "cam0" / "data.csv").write_text(f"{stamp},a.png\n")
    with pytest.raises(RecordingError, match="is no stamp in nanoseconds"):
        open_recording(tmp_path, None)


@pytest.mark.parametrize("late, level", [(20_000_000, "ok"), (-5_000_000, "warning"), (600_000_000, "warning")])
def test_how_long_after_their_stamps_images_were_recorded_is_said(late, level):
    report, statistics = Report(), checks.ImageStatistics(20)
    for stamp in range(0, 2_000_000_000, 100_000_000):
        statistics.add(CameraImage(stamp, "c", 64, 48, "mono8", np.zeros((48, 64), np.uint8)), stamp + late)
    checks.check_camera(report, "cam0", statistics, 5_000_000 * np.arange(400), None)
    delay = next(finding for finding in report.findings if finding.about == "camera cam0 delay")
    assert (delay.level, f"recorded {late // 1_000_000} ms after" in delay.text) == (level, True)


# -- against the truth -----------------------------------------------------------------------------------------------


def circle(n=400):
    t = np.linspace(0.0, 8.0, n)
    p = np.stack([np.cos(t), np.sin(t), 0.1 * t], axis=1)
    q = np.stack([np.zeros(n), np.zeros(n), np.sin(0.5 * t), np.cos(0.5 * t)], axis=1)
    return Trajectory((1.7e18 + 1e9 * t).astype(np.int64), p, q)


def test_place_and_heading_of_the_start_do_not_count_and_the_scale_does():
    truth = circle()
    c, s = np.cos(0.7), np.sin(0.7)
    turned = truth.p @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [3.0, -2.0, 1.0]
    yaw = np.array([0.0, 0.0, np.sin(0.35), np.cos(0.35)])
    q = np.stack([yaw[3] * truth.q[:, 2] + yaw[2] * truth.q[:, 3], yaw[3] * truth.q[:, 3] - yaw[2] * truth.q[:, 2]], axis=1)
    same = Trajectory(truth.stamps, turned, np.hstack([np.zeros((len(q), 2)), q]))
    e = evaluate(same, truth)
    assert e.figures["ate_rmse_m"] < 1e-9 and e.figures["final_error_m"] < 1e-6 and np.degrees(np.abs(e.turn).max()) < 1e-5
    assert abs(e.figures["scale"] - 1.0) < 1e-9
    larger = Trajectory(truth.stamps, turned[0] + 1.05 * (turned - turned[0]), same.q)
    assert evaluate(larger, truth).figures["scale"] == pytest.approx(1.05, abs=1e-6)
    assert evaluate(larger, truth).figures["final_error_m"] == pytest.approx(0.05 * np.linalg.norm(truth.p[-1] - truth.p[0]), rel=1e-6)


def test_nees_is_three_for_errors_as_large_as_they_are_said_to_be():
    truth, rng, sigma = circle(), np.random.default_rng(5), np.array([0.01, 0.02, 0.005])
    noise = sigma * rng.standard_normal((len(truth), 3))
    noise[0] = 0.0
    e = evaluate(Trajectory(truth.stamps, truth.p + noise, truth.q), truth, np.tile(np.diag(sigma**2), (len(truth), 1, 1)))
    assert 2.6 < e.figures["nees_position_mean"] < 3.4  # 1197 degrees of freedom: 3 +- 0.12 (1 sigma)


def test_a_path_too_straight_to_align_attitudes_by_says_nothing_of_them():
    # the start of EuRoC's V1_01: a rise of 14 cm, 2 mm across; attitudes are exact, and evo's alignment alone turns them by degrees
    n, rng = 600, np.random.default_rng(4)
    p = np.stack([0.002 * rng.standard_normal(n), 0.002 * rng.standard_normal(n), np.linspace(0.0, 0.14, n)], axis=1)
    truth = Trajectory(5_000_000 * np.arange(n), p, np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
    e = evaluate(Trajectory(truth.stamps, p + 0.002 * rng.standard_normal((n, 3)), truth.q), truth)
    assert e.figures["ate_rmse_m"] < 0.004 and np.isnan(e.figures["ate_rmse_deg"]) and e.figures["attitude_rms_deg"] < 1e-5
    wide = Trajectory(truth.stamps, p + 0.1 * np.stack([np.sin(0.02 * np.arange(n)), np.cos(0.03 * np.arange(n)), np.zeros(n)], axis=1), truth.q)
    assert evaluate(Trajectory(truth.stamps, wide.p + 0.002 * rng.standard_normal((n, 3)), truth.q), wide).figures["ate_rmse_deg"] < 0.5


def test_truth_of_an_imu_that_is_turned_in_the_body_is_turned_with_it():
    truth, q_BI = circle(), np.array([0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)])
    told = truth.turned(q_BI)  # attitudes of the IMU
    assert evaluate(truth, told).figures["final_error_m"] > 0.5  # the heading of the start does not count, and with it the path is turned
    e = evaluate(truth, told.turned(q_BI * [-1, -1, -1, 1]))
    assert e.figures["final_error_m"] < 1e-6 and np.degrees(np.abs(e.turn).max()) < 1e-5


def test_poses_of_the_truth_count_however_rare_they_are():
    truth = circle(41)  # 5 Hz
    found, good = truth.at(truth.stamps)
    assert good.all()
    np.testing.assert_allclose(found.p, truth.p, atol=1e-12)
    assert not truth.at(truth.stamps[:-1] + 10**8)[1].any()


def test_trajectories_are_read_to_the_nanosecond(tmp_path):
    lines = {"-1.25": -1_250_000_000, "-0.5": -500_000_000, ".5": 500_000_000, "1.403715529267142926e+18": 1_403_715_529_267_142_926,
             "1403715529.267142926": 1_403_715_529_267_142_926}
    for text, stamp in lines.items():
        (tmp_path / "one.tum").write_text(f"{text} 0 0 0 0 0 0 1\n2e9 0 0 0 0 0 0 1\n")
        assert stamp in read_trajectory(tmp_path / "one.tum").stamps
    truth = circle(20)
    write_tum(tmp_path / "a.tum", truth)
    again = read_trajectory(tmp_path / "a.tum")
    assert (again.stamps == truth.stamps).all()
    np.testing.assert_allclose(again.p, truth.p, atol=1e-9)
    rows = [f"{s},{','.join(map(str, p))},{q[3]},{q[0]},{q[1]},{q[2]},0,0,0" for s, p, q in zip(truth.stamps, truth.p, truth.q)]
    (tmp_path / "data.csv").write_text("#timestamp, p, q\n" + "\n".join(rows))
    np.testing.assert_allclose(read_trajectory(tmp_path / "data.csv").q, truth.q, atol=1e-9)
    with pytest.raises(RecordingError, match="in common"):
        evaluate(circle(), Trajectory(truth.stamps + 10**12, truth.p, truth.q))
