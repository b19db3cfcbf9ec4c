"""Flights that were recorded: figures, animation, plots and report of a file are those of the values that were flown; refusals."""

import json
import math

import cv2
import numpy as np
import pytest
from PIL import Image

from perch_core.trajectory import rest_to_rest
from perch_core.values import (
    AtEnd, CompressedPixels, Contact, ControllerCommand, ControllerStatus, ControlReference, EstimatorHealth, MotorCommand, OdometryState,
    PoseStamped, RotorState, TargetPose, TrajectoryOrder, rotated)
from perch_core.vehicle import load_vehicle
from perch_eval.flight import Flight, timed
from perch_eval.mcap_log import read
from perch_eval.metrics import flight_metrics, perch_window, rates
from perch_eval.replay.command import main
from perch_eval.replay.scene import View
from perch_eval.replay.stroboscope import stroboscope
from perch_eval.report import build_report
from perch_eval.ros.recorded_flight import RecordedFlight, write
from perch_sim.scenario import load_scenario

STEP = 2_000_000  # [ns]
STEPS = range(500, 2000)
ZERO = np.zeros((6, 6))
PATH = rest_to_rest([0.0, 0.0, 1.0], [2.0, 0.0, 1.0], 0.0, 0.0, 2.0, start_time=1.5)
BIAS = np.array([0.03, 0.0, -0.01])  # of the estimate [m]


def flown():
    """Channels of a flight along a known path: the estimate is off by `BIAS`, the target by 4 cm, contact at 3.4 s."""
    out = {name: [] for name in ("ground_truth/odometry", "odometry", "motor_command", "rotor_state", "controller/reference")}
    for k in STEPS:
        stamp = k * STEP
        sample = PATH.sample(min(max(k * 0.002 - 1.5, 0.0), PATH.duration))
        q = (0.0, math.sin(0.1), 0.0, math.cos(0.1))
        v_B = rotated(q, tuple(sample.v), -1.0)
        out["ground_truth/odometry"].append(OdometryState(stamp, tuple(sample.p), q, v_B, (0.0, 0.5, 0.0), ZERO, ZERO))
        out["odometry"].append(OdometryState(stamp, tuple(sample.p + BIAS), q, v_B, (0.0, 0.5, 0.0), 1e-4 * np.eye(6), 1e-4 * np.eye(6)))
        out["motor_command"].append(MotorCommand(stamp, True, (1200.0,) * 4))
        if k % 5 == 0:
            out["rotor_state"].append(RotorState(stamp, (1200.0,) * 4, (0.6,) * 4))
        if k >= 750:
            out["controller/reference"].append(ControlReference(stamp, 1, tuple(sample.p), q, tuple(sample.v), (0.0,) * 3, (0.0,) * 3, (0.0,) * 3, 2.4, (0.0,) * 3))
    image = np.full((48, 64), 120, np.uint8)
    packed = cv2.imencode(".jpg", image)[1].tobytes()
    out |= {
        "ground_truth/target": [PoseStamped(1_000_000_000, (2.0, 0.0, 1.0), (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)))],
        "target/pose": [TargetPose(1_200_000_000, np.array([2.0, 0.04, 1.0]), np.array([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)]), 1e-4 * np.eye(6))],
        "trajectory": [TrajectoryOrder(1, PATH, AtEnd.CONTACT, 0.25)],
        "contact": [Contact(1_100_000_000, 0, "ground", 0.0, 0.0, 0.0, 0.0, ""), Contact(3_400_000_000, 1, "pad", 0.7, 0.1, 0.02, 0.03, "")],
        "controller/command": [ControllerCommand(1_000_000_000, 1, "take-off")],
        "controller/status": [ControllerStatus(k * STEP, 3, "geometric", 1, 0.0, 2.0, 0.0, 0.0, 0.5, "tracking") for k in STEPS[::10]],
        "estimator/status": [EstimatorHealth(k * STEP, 1, 0.02, k, 0, 3.0, (0.0,) * 3, (0.0,) * 3, 0.01, 0.01, "") for k in STEPS[::50]],
        "camera_front/image_raw/compressed": [CompressedPixels(k * STEP, "camera_front_optical_frame", "jpeg", packed) for k in STEPS[::100]],
    }
    return {channel: timed(values) for channel, values in out.items()}


def record(path, channels):
    """The same as a file, in the order of time."""
    write(path, sorted(((channel, round(1e9 * t), value) for channel, values in channels.items() for t, value in values), key=lambda item: item[1]))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The file and the flight of its values."""
    channels, path = flown(), tmp_path_factory.mktemp("replay") / "flight.mcap"
    record(path, channels)
    return path, Flight(channels)


def test_a_recording_is_the_flight_that_was_flown(recorded):
    path, flight = recorded
    found = RecordedFlight(path)
    assert found.digest(3.0) == flight.digest(3.0) != flight.digest(2.0)
    for field in "tpqvw":
        assert np.array_equal(getattr(found.states("odometry"), field), getattr(flight.states("odometry"), field))
        assert np.array_equal(getattr(found.reference(), field), getattr(flight.reference(), field))
    vehicle = load_vehicle("snapdragon")
    assert flight_metrics(found, vehicle, 4.0) == flight_metrics(flight, vehicle, 4.0)


def test_figures_are_what_was_put_in(recorded):
    _, flight = recorded
    found = flight_metrics(flight, load_vehicle("snapdragon"), 4.0)
    assert perch_window(flight) == (1.5, 3.4) and found["perch_planned"]
    assert found["estimation_rmse_m"] == pytest.approx(np.abs(BIAS), abs=1e-9) and found["velocity_rmse_m_s"] == pytest.approx([0.0] * 3, abs=1e-9)
    assert found["tracking_rmse_m"] == pytest.approx([0.0] * 3, abs=1e-9) and found["target_error"] == pytest.approx({"position_m": 0.04, "attitude_deg": 0.0})
    assert found["max_body_rate_deg_s"] == pytest.approx(math.degrees(0.5))
    assert (found["contact"]["state"], found["contact"]["body"], found["contact"]["normal_speed_m_s"]) == ("attached", "pad", 0.7)
    assert rates(flight)["odometry"] == pytest.approx(500.0) and rates(flight)["rotor_state"] == pytest.approx(100.0)


def test_any_change_of_a_hashed_value_changes_the_hash_and_what_comes_later_does_not():
    channels = flown()
    before = Flight(channels).digest(3.0)
    channels["odometry"] = [(t, s._replace(p_WB=(*s.p_WB[:2], s.p_WB[2] + 1e-12)) if t > 3.5 else s) for t, s in channels["odometry"]]
    assert Flight(channels).digest(3.0) == before
    channels["odometry"] = [(t, s._replace(p_WB=(*s.p_WB[:2], s.p_WB[2] + 1e-12)) if 2.0 < t < 2.003 else s) for t, s in channels["odometry"]]
    assert Flight(channels).digest(3.0) != before


def test_a_report_is_written(recorded, tmp_path):
    record(tmp_path / "flight.mcap", flown())
    report = build_report(tmp_path, load_scenario("surface_90"), 3, "perched", "held", 2.0, 4.0)
    assert json.loads((tmp_path / "report.json").read_text())["flight_hash"] == report["flight_hash"] == recorded[1].digest(4.0)
    page = (tmp_path / "report.html").read_text()
    for words in ("mission orders arm: take-off", "trajectory 1 (perch) starts, 2.00 s", "attached to pad", "front camera, t = 1.40 s"):
        assert words in page
    assert report["real_time_factor"] == pytest.approx(1.5)


def test_an_animation_has_a_frame_for_each_moment(recorded, tmp_path):
    path, _ = recorded
    gif = tmp_path / "f.gif"
    assert main([str(path), "--from", "1.2", "--to", "1.6", "--fps", "10", "--out", str(gif)]) == 0
    with Image.open(gif) as image:
        assert image.n_frames == 4


def test_a_stroboscopic_picture_shows_each_instant_of_the_perch(recorded, tmp_path):
    path, _ = recorded
    view, vehicle = View.of(RecordedFlight(path)), load_vehicle("snapdragon")
    figure = stroboscope(view, vehicle, 1.5, 3.4, 7)
    discs = [c for c in figure.axes[0].collections if c.get_zorder() > 3.0]
    assert len(discs) == 7 * 4
    assert any(text.get_text() == "+0.00 s, 11°" for text in figure.axes[0].texts)
    assert main([str(path), "--instants", "4", "--out", str(tmp_path / "f.png")]) == 0
    with Image.open(tmp_path / "f.png") as image:
        assert image.size == (1100, 616)


def test_mp4_needs_no_other_program(recorded, tmp_path, monkeypatch):
    path, _ = recorded
    monkeypatch.setenv("PATH", "")
    mp4 = tmp_path / "f.mp4"
    assert main([str(path), "--from", "1.2", "--to", "1.6", "--fps", "10", "--out", str(mp4)]) == 0
    video = cv2.VideoCapture(str(mp4))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (4, 10)
    found, frame = video.read()
    assert found and np.ptp(frame) > 100  # something is drawn


def test_plots_are_written(recorded, tmp_path):
    path, _ = recorded
    assert main([str(path), "--from", "1.2", "--to", "1.4", "--fps", "10", "--out", str(tmp_path / "f.gif"),
                 "--plots", str(tmp_path / "plots")]) == 0
    assert {"tracking.png", "path.png", "rates.png", "thrust.png"} <= {p.name for p in (tmp_path / "plots").iterdir()}


@pytest.mark.parametrize("options, words", [
    (["--from", "90"], "the flight lasts"),
    (["--fps", "0"], "--fps 0 is not a number > 0"),
    (["--out", "x.avi"], "neither .gif nor .mp4"),
    (["--speed", "inf"], "--speed inf is not a number > 0"),
    (["--vehicle", "zeppelin"], "zeppelin"),
])
def test_what_cannot_be_shown_is_refused_in_one_line(recorded, capsys, options, words):
    path, _ = recorded
    assert main([str(path), *options]) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.splitlines()) == 1


def test_a_damaged_recording_is_read_as_far_as_it_goes(recorded, tmp_path):
    path, flight = recorded
    whole, damaged = path.read_bytes(), tmp_path / "damaged.mcap"
    middle, count = len(whole) // 2, len(flight.values("odometry"))
    for content in (whole[:middle] + bytes(4096) + whole[middle + 4096:], whole[:middle]):
        damaged.write_bytes(content)
        assert 0 < len(RecordedFlight(damaged).values("odometry")) < count


def test_nothing_is_read_that_was_not_written(recorded, tmp_path):
    path, _ = recorded
    whole, damaged = path.read_bytes(), tmp_path / "damaged.mcap"
    written = list(read(path))
    for at in range(len(whole) // 20, len(whole), len(whole) // 10):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1:])
        seen = list(read(damaged))
        assert seen == written[:len(seen)]


def test_a_damaged_recording_is_said_to_be_one(recorded, tmp_path, capsys):
    path, _ = recorded
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(path.read_bytes()[:5000])
    assert RecordedFlight(path).damage == ""
    assert main([str(damaged)]) == 2
    assert "cut off or damaged" in capsys.readouterr().err


def test_no_recording_is_the_callers_mistake(tmp_path, capsys):
    assert main([str(tmp_path / "none.mcap")]) == 2
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert main([str(tmp_path / "empty.mcap")]) == 2
    assert "ground_truth/odometry" in capsys.readouterr().err
