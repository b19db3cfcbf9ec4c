"""Flights that were recorded: figures, animation, plots, report and comparison of a file are those of the values that were flown; refusals."""

import base64
import io
import json
import math
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from perch_core.trajectory import rest_to_rest
from perch_core.values import (
    AtEnd, CompressedPixels, Contact, ControllerCommand, ControllerStatus, ControlReference, EstimatorHealth, MotorCommand, OdometryState,
    PoseStamped, RotorState, TargetPose, TrajectoryOrder, rotated)
from perch_core.vehicle import load_vehicle
from perch_eval import comparison, report
from perch_eval.camera_clip import clip
from perch_eval.flight import Flight, timed
from perch_eval.flight_view import FlightView
from perch_eval.margins import limits, margins
from perch_eval.mcap_log import read
from perch_eval.metrics import flight_metrics, perch_window, rates
from perch_eval.page import Html, section, table
from perch_eval.replay.command import main
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
            zero = (0.0,) * 3
            out["controller/reference"].append(ControlReference(stamp, 1, tuple(sample.p), q, tuple(sample.v), zero, zero, zero, 2.4, zero))
    image = np.full((48, 64), 120, np.uint8)
    packed = cv2.imencode(".jpg", image)[1].tobytes()
    out |= {
        "ground_truth/target": [PoseStamped(1_000_000_000, (2.0, 0.0, 1.0), (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)))],
        "target/pose": [TargetPose(1_200_000_000, np.array([2.0, 0.04, 1.0]), np.array([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)]), 1e-4 * np.eye(6))],
        "trajectory": [TrajectoryOrder(1, PATH, AtEnd.CONTACT, 0.25)],
        "contact": [Contact(1_100_000_000, 0, "ground", 0.0, 0.0, 0.0, 0.0, ""), Contact(3_400_000_000, 1, "pad", 0.7, 0.1, 0.02, 0.03, "")],
        "controller/command": [ControllerCommand(1_000_000_000, 1, "take-off")],
        "controller/status": [ControllerStatus(k * STEP, 3, "geometric", 1, 0.0, 2.0, 0.0, 0.0, 0.5, 1.0, "tracking") for k in STEPS[::10]],
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


@pytest.fixture(scope="module")
def reported(recorded, tmp_path_factory):
    """The folder of a flight with its report, and what the report gave."""
    folder = tmp_path_factory.mktemp("reported")
    shutil.copy(recorded[0], folder)
    return folder, build_report(folder, load_scenario("surface_90"), 3, "perched", "held", 2.0, 4.0)


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


def test_a_report_is_written(recorded, reported):
    folder, written = reported
    assert json.loads((folder / "report.json").read_text())["flight_hash"] == written["flight_hash"] == recorded[1].digest(4.0)
    page = (folder / "report.html").read_text()
    for words in ("mission commands arm: take-off", "trajectory 1 (perch) starts, 2.00 s", "attached to pad",
                  "front camera, 1.00 to 3.80 s", "data:image/webp"):
        assert words in page
    assert written["real_time_factor"] == pytest.approx(1.5)
    assert "1.50: 3.00 s of simulated time in 2.00 s" in page


def test_the_clip_shows_what_the_cameras_saw_around_the_perch_at_the_speed_of_the_flight(recorded):
    data = re.search('data:image/webp;base64,([^"]*)', clip(RecordedFlight(recorded[0])))[1]
    images = Image.open(io.BytesIO(base64.b64decode(data)))
    assert images.n_frames == 15 and images.info["loop"] == 0  # 1.0 to 3.8 s by 0.2 s
    images.seek(3)
    images.load()
    assert images.info["duration"] == 200
    assert clip(Flight({})) == ""


def test_tables_escape_what_they_are_given():
    assert table([("<a>", "b & c", Html("<i>d</i>"))]) == "<table><tr><th>&lt;a&gt;</th><td>b &amp; c</td><td><i>d</i></td></tr></table>"
    assert table([]) == section("title", "") == "" and "<p>none</p>" in section("title", table([]), "none")


@pytest.mark.parametrize("key, words", [
    ("clock_offset_s", "clock offset 12.5 s"), ("steps_per_s", "steps 12.5 per s"),
    ("updates_rejected", "updates rejected 12.5")])
def test_diagnostics_are_words_with_units(key, words):
    assert report._with_unit(key, 12.5) == words


def test_an_animation_has_a_frame_for_each_moment(recorded, tmp_path):
    path, _ = recorded
    gif = tmp_path / "f.gif"
    assert main([str(path), "--from", "1.2", "--to", "1.6", "--fps", "10", "--out", str(gif)]) == 0
    with Image.open(gif) as image:
        assert image.n_frames == 4


def test_a_stroboscopic_picture_shows_each_instant_of_the_perch(recorded, tmp_path):
    path, _ = recorded
    view = FlightView.of(RecordedFlight(path), load_vehicle("snapdragon"))
    figure = stroboscope(view, 1.5, 3.4, 7)
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


# -- margins, and two flights side by side ---------------------------------------------------------------------------

def test_margins_are_distances_to_the_limits_of_vehicle_and_material(recorded):
    _, flight = recorded
    vehicle, scenario = load_vehicle("snapdragon"), load_scenario("surface_90")
    found = {one.name: one for one in margins(flight, vehicle, scenario)}
    assert found["greatest collective thrust"].left == pytest.approx(4 * vehicle.thrust_max - 2.4)
    assert found["least collective thrust"].left == pytest.approx(2.4 - 4 * vehicle.thrust_min)
    assert found["greatest body rate (limit of the plan)"].left == pytest.approx(math.degrees(vehicle.body_rate_max - 0.5))
    low, high = scenario.adhesion.normal_speed
    assert found["normal speed at contact"].left == pytest.approx(min(0.7 - low, high - 0.7))
    assert found["tilt error at contact"].left == pytest.approx(scenario.adhesion.tilt_error_max_deg - math.degrees(0.02))
    strict = replace(scenario, adhesion=replace(scenario.adhesion, tangential_speed_max=0.08))
    assert [one.name for one in margins(flight, vehicle, strict) if one.left < 0.0] == ["tangential speed at contact"]
    assert "contact" not in "".join(one.name for one in margins(flight, vehicle))


def test_limits_are_words_also_after_json():
    assert [limits({"low": low, "high": high}) for low, high in ((0.2, 1.0), (-math.inf, 4.5), (None, 4.5), (0.5, None))] == [
        "0.2 to 1", "at most 4.5", "at most 4.5", "at least 0.5"]


def compared(page):
    """(figure) -> cells of its row, and the verdict, of a page."""
    rows = re.findall(r"<tr><th>([^<]*)</th>((?:<td>[^<]*</td>)+)</tr>", page)
    return {name: re.findall("<td>([^<]*)</td>", cells) for name, cells in rows}, re.search(r"<p>(The two are [^.,]*)", page)[1]


def test_two_flights_are_on_one_page(recorded, tmp_path, monkeypatch):
    """The second flight is off by 5 cm of estimate more in y, and was reported."""
    a, b = tmp_path / "a", tmp_path / "b"
    for folder in (a, b):
        folder.mkdir()
    shutil.copy(recorded[0], a)
    channels = flown()
    channels["odometry"] = [(t, state._replace(p_WB=tuple(np.add(state.p_WB, (0.0, 0.05, 0.0))))) for t, state in channels["odometry"]]
    record(b / "flight.mcap", channels)
    with monkeypatch.context() as patch:
        patch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
        build_report(b, load_scenario("surface_90"), 7, "perched", "held <by velcro>", 2.0, 4.0)
    page = tmp_path / "pages" / "ab.html"
    assert comparison.main([str(a), str(b / "flight.mcap"), "--names", "<one>", "other", "--out", str(page)]) == 0
    text = page.read_text()
    rows, verdict = compared(text)
    assert verdict == "The two are different flights"
    assert rows["estimation RMSE y [cm]"] == ["0.00", "5.00", "+5.00"] and rows["tracking RMSE x [cm]"] == ["0.00", "0.00", "+0.00"]
    assert rows["outcome"] == ["-", "perched", ""] and rows["seed"] == ["-", "7", ""] and rows["message"][1] == "held &lt;by velcro&gt;"
    assert rows["tilt error at contact [deg]"][:2] == ["at most 15", "-"], "limits of the material are those of the report"
    assert text.count("data:image/png;base64,") == 5 and "<one>" not in text


@pytest.mark.parametrize("page", ["report", "comparison"])
def test_a_flight_can_be_turned_on_a_page_that_needs_no_network(page, reported, tmp_path, monkeypatch):
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    folder, _ = reported
    file = folder / "report.html"
    if page == "comparison":
        file = tmp_path / "comparison.html"
        assert comparison.main([str(folder), str(folder), "--out", str(file)]) == 0
        assert compared(file.read_text())[1] == "The two are the same flight"
    text = file.read_text()
    assert not re.search(r"""(?:src|href)=["'](?!data:)|https?://|@import|fetch\(""", text)
    found = json.loads(re.search(r'<script type="application/json">(.*?)</script>', text)[1])["flights"]
    assert len(found) == (1 if page == "report" else 2)
    for one in found:
        assert len(one["t"]) == len(one["p"]) == len(one["q"]) > 100 and len(one["pad"]) == 4 and len(one["rotors"]) == 4
        assert np.ptp([p[0] for p in one["p"]]) == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("content, words", [
    (None, "flight.mcap: no such recording"), (b"", "holds no ground_truth/odometry"), ("report", "report.json: cannot be read")])
def test_what_cannot_be_compared_is_one_line(content, words, recorded, tmp_path, capsys):
    path, _ = recorded
    if content == "report":
        shutil.copy(path, tmp_path)
        (tmp_path / "report.json").write_text("{")
    elif content is not None:
        (tmp_path / "flight.mcap").write_bytes(content)
    assert comparison.main([str(path), str(tmp_path), "--out", str(tmp_path / "page.html")]) == 2
    said = capsys.readouterr().err
    assert words in said and said.startswith("error: ") and said.count("\n") == 1
    assert not (tmp_path / "page.html").exists()
