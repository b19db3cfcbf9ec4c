"""Flights that were recorded: figures, animation, plots and report of a file are those of the values that were flown; refusals."""

import base64
import html
import io
import json
import os
import math
import re
import resource
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageSequence
from unit.recorded_flights import BIAS, PATH, flown, record

from perch_core import so3
from perch_core.urdf import urdf
from perch_core.values import NANOSECONDS, AtEnd, ImuSample, OdometryState, RatesThrust, TrajectoryOrder, rotated
from perch_core.vehicle import load_vehicle
from perch_eval import comparison, plots, report
from perch_eval.camera_clip import clip
from perch_eval.flight import Flight, timed
from perch_eval.flight_view import FlightView
from perch_eval.mcap_log import read
from perch_eval.metrics import figures, flight_metrics, perch_window, rates, thrust_history
from perch_eval.page import Html, figure_rows, in_words, section, table
from perch_eval.replay import animation, command
from perch_eval.replay.command import main
from perch_eval.replay.stroboscope import stroboscope
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.scene_3d import scene_3d


def test_a_recording_is_the_flight_that_was_flown(recorded):
    path, flight = recorded
    found = RecordedFlight(path)
    assert found.digest(3.0) == flight.digest(3.0) != flight.digest(2.0)
    for field in "tpqvw":
        assert np.array_equal(getattr(found.states("odometry"), field), getattr(flight.states("odometry"), field))
        assert np.array_equal(getattr(found.reference(), field), getattr(flight.reference(), field))
    assert flight_metrics(found, 4.0) == flight_metrics(flight, 4.0)


def test_figures_are_what_was_put_in(recorded):
    _, flight = recorded
    found = flight_metrics(flight, 4.0)
    assert perch_window(flight) == (1.5, 3.4) and found["perch_planned"]
    assert found["estimation_rmse_m"] == pytest.approx(np.abs(BIAS), abs=1e-9) and found["velocity_rmse_m_s"] == pytest.approx([0.0] * 3, abs=1e-9)
    assert found["tracking_rmse_m"] == pytest.approx([0.0] * 3, abs=1e-9) and found["target_error"] == pytest.approx({"position_m": 0.04, "attitude_deg": 0.0})
    assert found["max_body_rate_deg_s"] == pytest.approx(math.degrees(0.5))
    planned = np.linalg.norm([PATH.sample(t).a for t in np.linspace(0.0, 1.9, 500)], axis=1).max()
    assert found["max_acceleration_m_s2"] == pytest.approx(planned, rel=0.01)
    assert (found["contact"]["state"], found["contact"]["body"], found["contact"]["normal_speed_m_s"]) == ("attached", "pad", 0.7)
    assert rates(flight)["odometry"] == pytest.approx(500.0) and rates(flight)["rotor_state"] == pytest.approx(100.0)


def test_errors_that_were_put_in_are_found_each_under_its_name():
    """A reference 2 and 3 cm beside the path, an estimate turned by 2 deg and 0.1 m/s too fast, a pad turned by 3 deg."""
    channels, turn = flown(), so3.quat_exp(np.radians([0.0, 0.0, 2.0]))

    def estimated(state):
        q = so3.quat_multiply(turn, np.array(state.q_WB))
        v_W = np.add(rotated(state.q_WB, state.v_B, 1.0), (0.1, 0.0, -0.05))
        return state._replace(q_WB=tuple(q.tolist()), v_B=rotated(tuple(q.tolist()), tuple(v_W.tolist()), -1.0))

    channels["odometry"] = [(t, estimated(state)) for t, state in channels["odometry"]]
    channels["controller/reference"] = [(t, x._replace(p=tuple(np.add(x.p, (0.02, 0.0, -0.03)).tolist()))) for t, x in channels["controller/reference"]]
    [(t, pad)] = channels["target/pose"]
    channels["target/pose"] = [(t, pad._replace(q_WS=so3.quat_multiply(so3.quat_exp(np.radians([0.0, 0.0, 3.0])), pad.q_WS)))]
    found = flight_metrics(Flight(channels), 4.0)
    assert found["tracking_rmse_m"] == pytest.approx([0.02, 0.0, 0.03], abs=1e-9)
    assert found["velocity_rmse_m_s"] == pytest.approx([0.1, 0.0, 0.05], abs=1e-6)
    assert found["attitude_error_at_end_deg"] == pytest.approx(2.0, abs=1e-6) and found["estimation_error_at_end_m"] == pytest.approx(BIAS, abs=1e-9)
    assert found["target_error"] == pytest.approx({"position_m": 0.04, "attitude_deg": 3.0}, abs=1e-6)


@pytest.mark.parametrize("channel", ["motor_command", "rates_thrust_command"])
def test_thrusts_that_are_commanded_and_reached_are_those_of_rotors_or_autopilot(channel):
    """k Omega^2 of four rotors at 1200 rad/s, or the mass times 9 m/s^2; no thrust while commands have the motors off."""
    channels, vehicle = flown(), load_vehicle("snapdragon")
    given = {"motor_command": channels["motor_command"], "rates_thrust_command": timed(
        RatesThrust(command.stamp, True, (0.0,) * 3, 9.0) for _, command in channels["motor_command"])}[channel]
    del channels["motor_command"]
    channels[channel] = [(t, command._replace(armed=t < 3.0)) for t, command in given]
    t, thrust, commanded = thrust_history(Flight(channels), vehicle)
    expected = {"motor_command": 4.0 * vehicle.thrust_coefficient * 1200.0**2, "rates_thrust_command": 9.0 * vehicle.mass}[channel]
    assert len(t) == 300 and thrust == pytest.approx(2.4)
    assert commanded[t < 2.99] == pytest.approx(expected) and not commanded[t > 3.0].any()


def test_rotors_that_are_reported_only_while_they_stand_are_no_thrust_in_flight():
    """As the nodes of autopilots report them."""
    channels, vehicle = flown(), load_vehicle("snapdragon")
    assert len(thrust_history(Flight(channels), vehicle)[0]) > 100
    channels["rotor_state"] = [(t, rotors._replace(speed=(0.0,) * 4, thrust=(0.0,) * 4)) for t, rotors in channels["rotor_state"][:9]]
    assert len(thrust_history(Flight(channels), vehicle)[0]) == 0


def test_figures_are_of_the_attempt_that_touched_and_of_what_is_known():
    """A plan from -1 to 1 s has ended in a recovery; the estimator falls silent at 3 s."""
    channels = flown()
    early = TrajectoryOrder(0, replace(PATH, start_time=-1.0), AtEnd.CONTACT, 0.25)
    channels["trajectory"] = timed([early, *(order for _, order in channels["trajectory"])])
    channels["odometry"] = [(t, state) for t, state in channels["odometry"] if t < 3.0]
    channels["controller/reference"] = [(t, state) for t, state in channels["controller/reference"] if not 2.0 < t < 2.4]
    found = flight_metrics(Flight(channels), 4.0)
    assert found["window_s"] == [1.5, 3.4]
    assert found["estimation_rmse_m"] == pytest.approx(np.abs(BIAS), abs=1e-9) and "estimation_error_at_end_m" not in found
    assert found["tracking_rmse_m"] == pytest.approx([0.0] * 3, abs=1e-9)
    assert found["estimation_judged"] == pytest.approx(1.5 / 1.9, abs=2e-3) and found["tracking_judged"] == pytest.approx(1.5 / 1.9, abs=2e-3)


def test_the_target_is_judged_as_it_was_when_the_plan_was_requested():
    """A tenth of a second before the plan's start at 1.5 s; what is seen after that cannot have been planned on."""
    channels = flown()
    [(t, pose)] = channels["target/pose"]
    seen = [pose._replace(stamp=round(1e9 * time), p_WS=pose.p_WS + (0.0, error, 0.0)) for time, error in ((1.2, 0.5), (1.39, 0.01), (1.41, 0.3))]
    channels["target/pose"] = timed(seen)
    assert flight_metrics(Flight(channels), 4.0)["target_error"]["position_m"] == pytest.approx(0.05)


def test_rates_without_a_perch_are_not_compared_with_those_of_a_perch(recorded):
    found = flight_metrics(recorded[1], 4.0)
    assert "max_body_rate_deg_s" in figures(found, 4.0) and "max_acceleration_m_s2" in figures(found, 4.0)
    hover = figures(found | {"perch_planned": False}, 4.0)
    assert "max_body_rate_deg_s" not in hover and "max_acceleration_m_s2" not in hover


def test_any_change_of_a_hashed_value_changes_the_hash_and_what_comes_later_does_not():
    channels = flown()
    before = Flight(channels).digest(3.0)
    channels["odometry"] = [(t, s._replace(p_WB=(*s.p_WB[:2], s.p_WB[2] + 1e-12)) if t > 3.5 else s) for t, s in channels["odometry"]]
    assert Flight(channels).digest(3.0) == before
    channels["odometry"] = [(t, s._replace(p_WB=(*s.p_WB[:2], s.p_WB[2] + 1e-12)) if 2.0 < t < 2.003 else s) for t, s in channels["odometry"]]
    assert Flight(channels).digest(3.0) != before


@pytest.mark.parametrize("channel, change", [
    ("ground_truth/odometry", lambda x: x._replace(w_B=(*x.w_B[:2], x.w_B[2] + 1e-12))), ("odometry", lambda x: x._replace(q_WB=(1e-12, *x.q_WB[1:]))),
    ("odometry", lambda x: x._replace(pose_covariance=x.pose_covariance + 1e-12)), ("odometry", lambda x: x._replace(stamp=x.stamp + 1000)),
    ("imu/data_raw", lambda x: x._replace(f_B=(*x.f_B[:2], x.f_B[2] + 1e-9))), ("vio/odometry", lambda x: x._replace(v_B=(1e-12, 0.0, 0.0))),
    ("target/pose", lambda x: x._replace(p_WS=x.p_WS + 1e-12)), ("motor_command", lambda x: x._replace(armed=False)),
    ("trajectory", lambda x: x._replace(trajectory=replace(x.trajectory, coefficients=x.trajectory.coefficients + 1e-12))),
    ("trajectory", lambda x: x._replace(at_end=AtEnd.RECOVER)), ("controller/reference", lambda x: x._replace(a=(1e-12, 0.0, 0.0)))])
def test_one_number_of_one_state_command_or_estimate_changes_the_hash(recorded, channel, change):
    channels = {name: recorded[1].values(name)[:20] for name in recorded[1].topics}
    still = OdometryState(2 * NANOSECONDS, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, np.eye(6), np.eye(6))
    channels |= {"imu/data_raw": timed([ImuSample(2 * NANOSECONDS, (0.0,) * 3, (0.0, 0.0, 9.81))]), "vio/odometry": timed([still])}
    before = Flight(channels).digest(4.0)
    (t, first), *rest = channels[channel]
    assert Flight(channels | {channel: [(t, change(first)), *rest]}).digest(4.0) != before
    assert Flight(channels | {channel: rest}).digest(4.0) != before == Flight(channels).digest(4.0)


def test_a_report_is_written(recorded, reported):
    folder, written = reported
    assert json.loads((folder / "report.json").read_text())["flight_hash"] == written["flight_hash"] == recorded[1].digest(4.0)
    page = (folder / "report.html").read_text()
    for words in ("mission commands arm: take-off", "trajectory 1 (perch) starts, takes 2.00 s", "attached to pad",
                  "front camera, 1.00 to 3.80 s", "data:image/webp"):
        assert words in page
    for row in ("<th>vehicle</th><td>snapdragon</td>",
                f"<th>date</th><td>{written['date']}</td>", f"<th>commit</th><td>{written['commit']} (digest {written['digest']})</td>",
                "<td>0.7 m/s (0.2 to 1 m/s): +0.3 m/s left</td>"):
        assert row in page
    reported_at = datetime.strptime(written["date"], "%Y-%m-%d %H:%M UTC").replace(tzinfo=UTC)
    assert abs(datetime.now(UTC) - reported_at) < timedelta(hours=1)
    assert written["real_time_factor"] == pytest.approx(1.5)
    assert f"<th>made by</th><td>{html.escape(written['command'])} on {written['machine']}</td>" in page and "cores, Python 3" in written["machine"]
    assert "1.50: 3.00 s of simulated time in 2.00 s" in page


def test_everything_on_the_page_of_a_flight_ends_with_it(recorded):
    flight = RecordedFlight(recorded[0])
    view = FlightView.from_flight(flight, load_vehicle("snapdragon"), until=3.5)
    assert view.around(0.5, 1.0) == (1.0, 3.5)
    shown = json.loads(re.search(r'<script type="application/json">(.*?)</script>', scene_3d([view]))[1])["flights"][0]
    assert shown["t"][-1] == 3.5
    for figure in (plots.error_figure(view), plots.tracking_figure(view), plots.rates_figure(view)):
        assert figure.axes[0].get_xlim()[1] == 3.5
    assert "front camera, 1.00 to 3.40 s" in clip(flight, 3.5)


def test_a_replanned_trajectory_is_distinct_from_one_that_starts():
    again = replace(PATH, start_time=PATH.start_time + 0.5)
    orders = [TrajectoryOrder(5, path, AtEnd.RECOVER, 0.25, 1.2) for path in (PATH, again)]
    assert [text for _, text in report._timeline(Flight({"trajectory": timed(orders)}))] == [
        f"trajectory 5 (powerline perch with recovery) {verb} {PATH.duration:.2f} s, of which {PATH.duration - 1.2:.2f} s are recovery"
        for verb in ("starts, takes", "is re-planned, what remains takes")]


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
    assert " ".join(in_words(key, 12.5)) == words


def test_figures_are_rows_with_units_and_none_of_what_is_not_known():
    figures = {"damage": "", "vio": {"path_m": 1.5, "ate_rmse_deg": np.nan}, "frame_ms": {"p99": 12.0}, "problems": ["a", "b"]}
    assert figure_rows(figures) == [("vio path", "1.5 m"), ("frame p99", "12 ms"), ("problems", "a"), ("problems", "b")]


def test_an_animation_has_a_frame_for_each_moment_and_plots_are_written(recorded, tmp_path):
    path, _ = recorded
    gif = tmp_path / "f.gif"
    assert main([str(path), "--from", "1.2", "--to", "1.6", "--fps", "10", "--out", str(gif), "--plots", str(tmp_path / "plots")]) == 0
    with Image.open(gif) as image:
        assert image.n_frames == 4
    assert {"tracking.png", "path.png", "rates.png", "thrust.png"} <= {p.name for p in (tmp_path / "plots").iterdir()}


@pytest.mark.parametrize("speed, times", [("1", [1.2, 1.3, 1.4, 1.5]), ("0.5", [1.2, 1.25, 1.3, 1.35, 1.4, 1.45, 1.5, 1.55]), ("2", [1.2, 1.4])])
def test_slow_motion_shows_more_moments_of_the_same_time(recorded, tmp_path, monkeypatch, speed, times):
    drawn = []
    monkeypatch.setattr(command, "Scene", lambda *_: None)
    monkeypatch.setattr(command, "write_animation", lambda scene, times, fps, file: drawn.append((times, fps)) or file.touch())
    assert main([str(recorded[0]), "--from", "1.2", "--to", "1.6", "--fps", "10", "--speed", speed, "--out", str(tmp_path / "f.gif")]) == 0
    [(shown, fps)] = drawn
    assert fps == 10.0 and shown == pytest.approx(np.array(times))


def test_an_animation_of_a_vehicle_without_front_camera_shows_the_images_of_the_other_one(recorded):
    flight = RecordedFlight(recorded[0])
    truth, images = (flight.values(channel) for channel in ("ground_truth/odometry", "camera_front/image_raw/compressed"))
    for name, title in (("down", "down camera"), ("side", "no camera images recorded")):
        view = FlightView.from_flight(Flight({"ground_truth/odometry": truth, f"camera_{name}/image_raw/compressed": images}), load_vehicle("snapdragon"))
        assert title in [axes.get_title() for axes in animation.Scene(view, 1.2, 1.6).figure.axes]


@pytest.mark.parametrize("fps", [12.0, 15.0, 60.0])
def test_an_animation_takes_its_time(fps, tmp_path):
    animation._write_gif(tmp_path / "f.gif", fps, (np.full((8, 8, 3), k, np.uint8) for k in range(61)))
    with Image.open(tmp_path / "f.gif") as image:
        total = sum(frame.info["duration"] for frame in ImageSequence.Iterator(image))
    assert total == pytest.approx(1000.0 * 61 / fps, abs=10.0)


def test_two_recordings_of_a_flight_are_the_same_flight_though_one_has_a_report(recorded, undrawn):
    path, flight = recorded
    one = comparison.read("a", "r", path)
    other = replace(one, until=one.until - 0.1, report={**one.report, "flight_hash": flight.digest(one.until - 0.1)})
    assert "to the last bit" in comparison.compare(one, other)


def test_a_stroboscopic_picture_shows_each_instant_of_the_perch(recorded, tmp_path):
    path, _ = recorded
    view = FlightView.from_flight(RecordedFlight(path), load_vehicle("snapdragon"))
    figure = stroboscope(view, 1.5, 3.4, 7)
    discs = [c for c in figure.axes[0].collections if c.get_zorder() > 3.0]
    assert len(discs) == 7 * 4
    assert any(text.get_text() == "+0.00 s, 11°" for text in figure.axes[0].texts)
    assert main([str(path), "--instants", "4", "--out", str(tmp_path / "f.png")]) == 0
    with Image.open(tmp_path / "f.png") as image:
        assert image.size == (1100, 616)


def test_labels_of_a_stroboscopic_picture_cover_no_other_body(recorded):
    view = FlightView.from_flight(RecordedFlight(recorded[0]), load_vehicle("snapdragon"))
    descent = view.truth.p[:, :1] * [0.1, 0.0, -0.8] + [0.0, 0.0, 3.0]
    figure = stroboscope(replace(view, truth=replace(view.truth, p=descent)), 1.5, 3.4, 9)
    axes, labels = figure.axes[0], [text for text in figure.axes[0].texts if "°" in text.get_text()]
    discs = [disc.get_datalim(axes.transData).transformed(axes.transData) for disc in axes.collections if disc.get_zorder() > 3.0]
    assert len(labels) > 3 and all(sum(label.get_window_extent().overlaps(disc) for disc in discs) == 0 for label in labels)


def test_mp4_needs_no_other_program(recorded, tmp_path, monkeypatch):
    path, _ = recorded
    monkeypatch.setenv("PATH", "")
    mp4 = tmp_path / "f.mp4"
    assert main([str(path), "--from", "1.2", "--to", "1.6", "--fps", "10", "--out", str(mp4)]) == 0
    video = cv2.VideoCapture(str(mp4))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (4, 10)
    found, frame = video.read()
    assert found and np.ptp(frame) > 100  # something is drawn


@pytest.mark.parametrize("name", ["f.gif", "f.mp4", "f.png"])
def test_a_picture_that_cannot_be_written_to_its_end_is_refused_and_the_one_before_is_kept(recorded, tmp_path, capsys, monkeypatch, name):
    """A limit on the size of files stands for a full disk, which OpenCV does not report. Animations show noise, which is drawn at once."""
    path, _ = recorded
    monkeypatch.setattr(animation, "_frames", lambda scene, times: np.random.default_rng(1).integers(0, 256, (len(times), 240, 320, 3), np.uint8))
    options = [str(path), "--from", "1.2", "--to", "1.4", "--fps", "10", "--out", str(tmp_path / name)]
    (tmp_path / name).write_text("before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))
    try:
        assert main(options) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert f"error: --out: {tmp_path / name}: cannot be written: " in capsys.readouterr().err
    assert [file.read_text() for file in tmp_path.iterdir()] == ["before"]
    assert main(options) == 0 and (tmp_path / name).stat().st_size > 3000 and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("option, name", [("--out", "f.gif"), ("--out", "f.mp4"), ("--out", "f.png"), ("--plots", "plots")])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_drawn(recorded, monkeypatch, capsys, option, name):
    for drawing in ("write_animation", "stroboscope", "write_plots"):
        monkeypatch.setattr(command, drawing, lambda *_: pytest.fail("drawn"))
    assert main([str(recorded[0]), option, f"/proc/{name}"]) == 2
    assert f"error: {option}: /proc/{name}: cannot be written: No such file or directory" in capsys.readouterr().err


def test_a_pipe_is_not_replaced_by_a_picture(recorded, tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.png")
    assert main([str(recorded[0]), "--out", str(tmp_path / "pipe.png")]) == 2
    assert f"error: --out: {tmp_path / 'pipe.png'}: is no regular file" in capsys.readouterr().err and (tmp_path / "pipe.png").is_fifo()


def test_the_vehicle_is_that_of_the_recording_or_of_its_report(reported, tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr(command, "stroboscope", lambda view, *_: drawn.append(view.vehicle.name) or Figure())
    monkeypatch.setattr(command, "write_plots", lambda view, folder, thrust: drawn.append(thrust))
    other = flown()
    record(tmp_path / "rpg.mcap", other | {"odometry": other["odometry"][5:], "robot_description": [(1.0, urdf(load_vehicle("rpg")))]})
    record(tmp_path / "unknown.mcap", flown() | {"robot_description": []})
    shutil.copy(reported[0] / "report.json", tmp_path)
    for name in ("rpg", "unknown"):
        assert main([str(tmp_path / f"{name}.mcap"), "--out", str(tmp_path / "f.PNG"), "--plots", str(tmp_path)]) == 0
    assert drawn == ["rpg", True, "snapdragon", True], "the flight without a description is that of the report"
    assert capsys.readouterr().err.count("is not the report of") == 1
    (tmp_path / "report.json").unlink()
    assert main([str(tmp_path / "unknown.mcap"), "--out", str(tmp_path / "f.png"), "--plots", str(tmp_path)]) == 0
    assert drawn[-1] is False and "vehicle is not known" in capsys.readouterr().err


@pytest.mark.parametrize("options, words", [
    (["--from", "90"], "the flight lasts"),
    (["--fps", "0"], "--fps 0 is not a number > 0"),
    (["--out", "x.avi"], "none of .gif, .mp4 and .png"),
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
    written, lengths = list(read(path)), []
    for at in range(len(whole) // 20, len(whole), len(whole) // 10):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1:])
        seen = list(read(damaged))
        assert seen == written[:len(seen)]
        lengths.append(len(seen))
    assert max(lengths) > 0.8 * len(written), "what comes before the damage is read"


def test_a_damaged_recording_is_said_to_be_one(recorded, tmp_path, capsys):
    path, _ = recorded
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(path.read_bytes()[:5000])
    assert RecordedFlight(path).damage == ""
    for program, arguments in ((main, [str(damaged)]), (comparison.main, [str(path), str(damaged), "--out", str(tmp_path / "page.html")])):
        assert program(arguments) == 2
        said = capsys.readouterr().err
        assert "not read as a whole" in said and "holds no ground_truth/odometry as far as it can be read" in said


def test_a_folder_stands_for_its_recording(recorded, tmp_path):
    path, _ = recorded
    shutil.copy(path, tmp_path / "flight.mcap")
    assert main([str(tmp_path), "--instants", "2", "--out", str(tmp_path / "f.png")]) == 0


def test_no_recording_is_invalid_input(tmp_path, capsys):
    assert main([str(tmp_path / "none.mcap")]) == 2
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert main([str(tmp_path / "empty.mcap")]) == 2
    assert "ground_truth/odometry" in capsys.readouterr().err
