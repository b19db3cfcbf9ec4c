"""Component `recorder`: messages as they came, images as JPEG at their rate, and no trouble with the disk ends anything."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest
from unit.recorded_flights import flown, record

from perch_core.ros import topics
from perch_core.values import (
    NANOSECONDS, CameraImage, Contact, ControllerCommand, ControllerStatus, MotorCommand, OdometryState, Serialized, TargetPose, TrajectoryOrder)
from perch_core.trajectory import rest_to_rest
from perch_eval.flight import Flight, timed
from perch_eval.mcap_log import read
from perch_eval import demo
from perch_eval.report import build_report, outcome_text, summary
from perch_eval.ros.recorded_flight import RecordedFlight, write
from perch_eval.ros.recorder import CHANNELS, Recorder, RecorderParameters
from perch_core.component import Diagnostics, Input, ports
from perch_sim.lockstep import LocalParticipant, Packet
from perch_sim.scenario import load_scenario

STEP = 2_000_000  # [ns]


class Recording:
    """A recorder, and the test as its host."""

    def __init__(self, path, resolve=None, **parameters):
        self.recorder = Recorder(RecorderParameters(file=str(path), **parameters))
        self.lines, self.path = [], path
        self.recorder.log.receivers.append(self.lines.append)
        if resolve is not None:
            self.recorder.resolve = resolve
        self.handlers = {port.channel(self.recorder): port.handler(self.recorder) for port in ports(type(self.recorder), Input)}
        self.recorder.warm_up()

    def give(self, channel, value, topic=None):
        stamp = getattr(value, "stamp", 0)
        self.handlers[channel](Serialized(topic or f"/{channel.lstrip('/')}", stamp, topics.encode(channel, value), topics.message_type(channel)))

    def fly(self, steps):
        for k in steps:
            self.give("odometry", state(k))
            self.give("motor_command", MotorCommand(k * STEP, True, (700.0 + k,) * 4))


def state(k):
    return OdometryState(k * STEP, (0.1 * k, 0.0, 1.0), (0.0, 0.0, 0.6, 0.8), (1.0, 2.0, 3.0), (0.0, 0.1, 0.2), np.eye(6) * 0.01, np.eye(6))


def image(stamp, encoding="mono8"):
    pixels = np.zeros((48, 64) if encoding == "mono8" else (48, 64, 3), np.uint8)
    pixels[:, :32] = 250 if encoding == "mono8" else (200, 30, 30)
    return CameraImage(stamp, "camera_front_optical_frame", 64, 48, encoding, lambda region: pixels)


def test_every_channel_has_a_lazy_port_that_waits_for_nothing():
    found = list(ports(Recorder, Input))
    assert {p._channel for p in found} == {*CHANNELS, "camera_down/image_raw", "camera_front/image_raw"} and all(p.lazy for p in found)


def test_what_is_recorded_is_read_back_value_by_value(tmp_path):
    recording = Recording(tmp_path / "f.mcap")
    recording.fly(range(100))
    order = TrajectoryOrder.of(3, rest_to_rest([0, 0, 1.0], [1.0, 0, 1.0], 0.0, 0.0, 2.0, start_time=7.5))
    recording.give("trajectory", order)
    recording.give("controller/status", ControllerStatus(100 * STEP, 3, "geometric", 3, 0.1, 2.0, 0.01, 0.0, 0.5, 1.0, "tracking"))
    recording.recorder.close()
    flight = RecordedFlight(recording.path)
    assert flight.topics == ["controller/status", "motor_command", "odometry", "trajectory"] and flight.damage == ""
    assert flight.values("motor_command") == timed(MotorCommand(k * STEP, True, (700.0 + k,) * 4) for k in range(100))
    read_back = flight.values("trajectory")[0]
    assert read_back[0] == 7.5 and read_back[1].id == 3 and np.array_equal(read_back[1].trajectory.coefficients, order.trajectory.coefficients)
    flown = Flight({"odometry": timed(map(state, range(100))), "trajectory": timed([order]), "motor_command": flight.values("motor_command")})
    assert flight.digest(10.0) == flown.digest(10.0) != flown.digest(0.1)
    assert np.array_equal(flight.states("odometry").v, flown.states("odometry").v) and flight.states("odometry").t[1] == 0.002
    times = {topic: time for topic, _, time, _ in read(recording.path)}
    assert times["/trajectory"] == 99 * STEP  # when it was sent, not when it starts


def test_values_are_taken_as_well_as_messages_and_topics_have_the_namespace(tmp_path):
    recording = Recording(tmp_path / "f.mcap", resolve=lambda channel: f"/quad1/{channel}")
    recording.handlers["odometry"](state(1))
    recording.give("odometry", state(2), "/quad1/odometry")
    recording.handlers["camera_front/image_raw"](image(3 * STEP))
    recording.recorder.close()
    assert [(topic, time) for topic, _, time, _ in read(recording.path)] == [
        ("/quad1/odometry", STEP), ("/quad1/odometry", 2 * STEP), ("/quad1/camera_front/image_raw/compressed", 3 * STEP)]
    assert [v.p_WB for _, v in RecordedFlight(recording.path, "quad1").values("odometry")] == [state(1).p_WB, state(2).p_WB]


class NoConversions:
    """A codec for packets whose messages exist already."""

    def decode(self, channel, data):
        pytest.fail(f"{channel}: read, although only its bytes are recorded")

    encode = decode


def test_in_lockstep_messages_of_other_processes_are_recorded_as_they_came(tmp_path):
    recorder = Recorder(RecorderParameters(file=str(tmp_path / "f.mcap")))
    recorder.warm_up()
    values = {"odometry": state(1), "controller/status": ControllerStatus(2 * STEP, 3, "geometric", 3, 0.1, 2.0, 0.01, 0.0, 0.5, 1.0, "tracking"),
              "trajectory": TrajectoryOrder.of(3, rest_to_rest([0, 0, 1.0], [1.0, 0, 1.0], 0.0, 0.0, 2.0, start_time=7.5))}
    messages = {channel: topics.encode(channel, value) for channel, value in values.items()}
    participant = LocalParticipant(recorder, codec=NoConversions())
    participant.begin(3 * STEP, [Packet.received(channel, data, NoConversions()) for channel, data in messages.items()])
    assert participant.results() == []
    recorder.close()
    assert [(topic, time, data) for topic, _, time, data in read(tmp_path / "f.mcap")] == [
        ("/odometry", STEP, messages["odometry"]), ("/controller/status", 2 * STEP, messages["controller/status"]),
        ("/trajectory", 2 * STEP, messages["trajectory"])]


def test_another_namespace_than_that_of_the_recording_holds_nothing(tmp_path):
    recording = Recording(tmp_path / "f.mcap")
    recording.fly(range(10))
    recording.recorder.close()
    assert RecordedFlight(recording.path).values("odometry") and not RecordedFlight(recording.path, "quad1").topics


@pytest.mark.parametrize("rate, count", [(0.0, 0), (0.5, 1), (6.0, 6), (60.0, 30)])
def test_images_are_kept_at_their_rate(tmp_path, rate, count):
    recording = Recording(tmp_path / "f.mcap", image_rate=rate)
    for k in range(30):
        recording.handlers["camera_front/image_raw"](image(k * 1_000_000_000 // 30, "rgb8"))
    recording.recorder.close()
    seen = RecordedFlight(recording.path).values("camera_front/image_raw/compressed")
    assert len(seen) == count
    if seen:
        pixels = seen[0][1].pixels()
        assert pixels.shape == (48, 64, 3) and pixels[24, 10, 2] > 150 > pixels[24, 10, 0]  # red, in BGR


def test_an_image_that_was_never_drawn_is_left_out(tmp_path):
    recording = Recording(tmp_path / "f.mcap")
    recording.handlers["camera_down/image_raw"](CameraImage(0, "camera_down_optical_frame", 64, 48, "mono8", lambda region: None))
    recording.recorder.close()
    assert RecordedFlight(recording.path).topics == []


def test_an_unwritable_file_is_said_once_and_the_flight_goes_on(tmp_path):
    recording = Recording(tmp_path / "no folder" / "f.mcap")
    recording.fly(range(10))
    recording.handlers["camera_front/image_raw"](image(0))
    recording.recorder.on_flush(0)
    recording.recorder.close()
    assert [line.level for line in recording.lines] == ["error"] and "No such file" in recording.lines[0].text


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a system without /dev/full")
def test_a_disk_that_is_full_from_the_beginning(tmp_path):
    recording = Recording("/dev/full")
    recording.fly(range(3000))
    recording.recorder.on_flush(0)
    recording.recorder.close()
    assert [line.level for line in recording.lines] == ["error"] and "No space left" in recording.lines[0].text


class Disk:
    """A file on a disk that takes so many bytes."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def write(self, data):
        taken = self.file.write(data[:max(0, self.room)])
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return taken

    def __getattr__(self, name):
        return getattr(self.file, name)


def test_what_was_written_before_the_disk_was_full_can_be_read(tmp_path, monkeypatch):
    path, opened = tmp_path / "f.mcap", open
    monkeypatch.setattr("builtins.open", lambda file, mode="r", *a, **k: (
        Disk(opened(file, mode, *a, **k), 200_000) if file == path else opened(file, mode, *a, **k)))
    recording = Recording(path)
    monkeypatch.setattr("builtins.open", opened)
    said = []
    recording.recorder.diagnostics.receivers.append(said.append)
    recording.fly(range(10))
    recording.recorder.on_flush(0)
    recording.fly(range(10, 20000))
    assert [s.level for s in said] == [0, 2]
    recording.recorder.on_flush(NANOSECONDS)
    recording.recorder.close()
    assert [line.level for line in recording.lines] == ["error"] and "No space left" in recording.lines[0].text
    assert [s.level for s in said] == [0, 2, 2]
    assert all("No space left" in s.message for s in said[1:])
    flight = RecordedFlight(path)
    count = len(flight.values("odometry"))
    assert flight.damage and 100 < count < 20000
    assert [v.p_WB for _, v in flight.values("odometry")] == [state(k).p_WB for k in range(count)]


def test_a_recording_that_broke_off_is_readable_up_to_there(tmp_path):
    recording = Recording(tmp_path / "f.mcap")
    recording.fly(range(3000))
    recording.recorder.close()
    whole = recording.path.read_bytes()
    cut, last = tmp_path / "cut.mcap", -1
    for share in np.linspace(0.0, 1.0, 14):
        cut.write_bytes(whole[:int(share * len(whole))])
        flight = RecordedFlight(cut)
        count = len(flight.values("odometry"))
        assert count >= last and [v.stamp for _, v in flight.values("odometry")] == [k * STEP for k in range(count)]
        assert bool(flight.damage) == (share < 1.0)
        last = count
    assert last == 3000


@pytest.mark.parametrize("content", [None, b"", b"\x89MCAP0\r\n", b"nonsense" * 100])
def test_a_flight_whose_recording_is_missing_or_empty_is_reported(tmp_path, content):
    if content is not None:
        (tmp_path / "flight.mcap").write_bytes(content)
    report = build_report(tmp_path, load_scenario("surface_90"), 1, "failed", "the disk was full", 2.0, 1.0)
    assert report["outcome"] == "failed" and (tmp_path / "report.html").exists()


def test_a_report_for_which_there_is_no_room_is_not_half_written_and_the_outcome_is_told(tmp_path, monkeypatch, capsys):
    for name in ("report.json", "report.html"):
        (tmp_path / name).write_text("of an earlier flight")
    (tmp_path / "report.html").unlink()
    (tmp_path / "report.html").symlink_to("/dev/full")
    report = build_report(tmp_path, load_scenario("surface_90"), 1, "perched", "attached", 2.0, 1.0)
    assert report["outcome"] == "perched" and "No space left on device" in report["unwritten"]
    assert not (tmp_path / "report.json").exists() and not (tmp_path / "report.html").exists()
    monkeypatch.setattr(demo, "fly", lambda *_: report)
    assert demo.main([]) == 2
    said = capsys.readouterr()
    assert "outcome: perched" in said.out and "cannot be written: No space left" in said.err and "Traceback" not in said.err


@pytest.mark.parametrize("came_off, code, words", [(False, 0, "outcome: perched\n"), (True, 1, "outcome: perched (came_off: ")])
def test_a_perch_is_one_by_the_truth_in_report_and_exit_code(undrawn, tmp_path, monkeypatch, capsys, came_off, code, words):
    flight = flown()
    flight["contact"] += [(3.5, Contact(3_500_000_000, 0, "pad", 0.0, 0.0, 0.0, 0.0, ""))] * came_off
    record(tmp_path / "flight.mcap", flight)
    report = build_report(tmp_path, load_scenario("surface_90"), 3, "perched", "held", 2.0, 4.0)
    monkeypatch.setattr(demo, "fly", lambda *_: report)
    assert demo.main([]) == code and words in capsys.readouterr().out
    assert ('class="bad"' in (tmp_path / "report.html").read_text()) == came_off and report["outcome"] == "perched"


@pytest.mark.parametrize("perch, part", [(True, ""), (False, ", of the whole recording")])
def test_figures_of_a_flight_without_a_planned_perch_are_named_as_those_of_the_whole_recording(undrawn, tmp_path, perch, part):
    flight = flown()
    if not perch:
        del flight["trajectory"]
    record(tmp_path / "flight.mcap", flight)
    names = dict(summary(build_report(tmp_path, load_scenario("surface_90"), 3, "perched", "held", 2.0, 4.0)))
    assert {f"{one}{part}" for one in ("tracking RMSE x, y, z", "estimation RMSE x, y, z", "largest body rate", "largest acceleration")} <= set(names)


def test_a_flight_with_a_command_and_a_contact_that_are_unknown_has_a_report(undrawn, tmp_path):
    contact = Contact(2 * NANOSECONDS, 9, "wall", 0.0, 0.0, 0.0, 0.0, "")
    record(tmp_path / "flight.mcap", flown() | {"controller/command": [(1.0, ControllerCommand(NANOSECONDS, 77, "by hand"))], "contact": [(2.0, contact)]})
    build_report(tmp_path, load_scenario("surface_90"), 3, "perched", "held", 2.0, 4.0)
    page = (tmp_path / "report.html").read_text()
    assert "mission commands 77: by hand" in page and "contact (truth): 9 wall" in page


def test_a_report_of_a_recording_without_truth_or_estimate_is_written(tmp_path):
    recording = Recording(tmp_path / "flight.mcap")
    recording.fly(range(50))
    recording.recorder.close()
    assert build_report(tmp_path, load_scenario("surface_90"), 1, "failed", "", 2.0, 1.0)["rates_hz"]["odometry"] == pytest.approx(500.0)


def test_how_it_goes_is_told_once_a_second_of_flight(tmp_path):
    recording = Recording(tmp_path / "f.mcap")
    said: list[Diagnostics] = []
    recording.recorder.diagnostics.receivers.append(said.append)
    for k in range(1000):
        recording.give("odometry", state(k))
        if k % 50 == 0:
            recording.recorder.on_flush(k * STEP)
    assert len(said) == 2 and said[-1].values["messages"] > 400
    recording.recorder.close()


def test_how_it_goes_is_told_where_the_clock_has_gone_back_too(tmp_path):
    recording = Recording(tmp_path / "f.mcap")
    said: list[Diagnostics] = []
    recording.recorder.diagnostics.receivers.append(said.append)
    for second in (100, 1, 2):
        recording.recorder.on_flush(second * NANOSECONDS)
    recording.recorder.close()
    assert [one.stamp for one in said] == [100 * NANOSECONDS, NANOSECONDS, 2 * NANOSECONDS]


@pytest.mark.parametrize("channel", ["odometry", "/diagnostics"])
@pytest.mark.parametrize("stamp", [-5 * NANOSECONDS, 2_100_000_000 * NANOSECONDS])
def test_a_stamp_of_another_clock_moves_no_time(tmp_path, stamp, channel):
    recording, now = Recording(tmp_path / "f.mcap"), 10 * NANOSECONDS
    recording.recorder.host_time = lambda: now
    recording.give("odometry", state(5000))
    foreign = Diagnostics(stamp) if channel == "/diagnostics" else state(0)._replace(stamp=stamp)
    recording.give(channel, foreign)
    recording.give("robot_description", "<robot/>")
    recording.recorder.close()
    assert [(topic, time) for topic, _, time, _ in read(recording.path)] == [
        ("/odometry", now), (f"/{channel.lstrip('/')}", now), ("/robot_description", now)]
    assert [line.level for line in recording.lines] == ["warning"] * (channel == "odometry")


def test_before_there_is_time_stamps_are_and_a_late_message_is_logged_when_it_comes(tmp_path):
    recording, now = Recording(tmp_path / "f.mcap"), [0]
    recording.recorder.host_time = lambda: now[0]
    recording.give("odometry", state(5000))
    now[0] = 20 * NANOSECONDS
    recording.give("target/pose", TargetPose(10 * NANOSECONDS, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.eye(6)))
    recording.recorder.close()
    assert [time for _, _, time, _ in read(recording.path)] == [10 * NANOSECONDS, 20 * NANOSECONDS] and recording.lines == []


def test_of_a_recording_across_a_restart_of_time_the_last_flight_is_read_with_a_warning(tmp_path):
    def flown(steps, x):
        for k in steps:
            stamp = k * STEP
            yield "ground_truth/odometry", stamp, state(k)._replace(p_WB=(x, 0.0, 1.0))
            yield "motor_command", stamp, MotorCommand(stamp, True, (x,) * 4)

    first, second = list(flown(range(2000), 1.0)), list(flown(range(1000), 2.0))
    late = [value for value in first[-20:] if value[0] == "motor_command"]  # the recorder reads one topic after the other
    write(tmp_path / "f.mcap", [*first[:-20], second[0], *late, *second[1:]])
    flight = RecordedFlight(tmp_path / "f.mcap")
    assert "time has restarted" in flight.damage and "at 0.000 s" in flight.damage
    assert flight.states("ground_truth/odometry").p[:, 0].tolist() == [2.0] * 1000
    assert [command.rotor_speed[0] for _, command in flight.values("motor_command")] == [2.0] * 1000
    assert flight.vectors("motor_command", lambda command: command.stamp)[0].tolist() == pytest.approx([2e-3 * k for k in range(1000)])


def test_recorders_that_are_started_together_write_files_of_their_own(tmp_path):
    recorders = [Recorder(RecorderParameters(file=str(tmp_path / "f.mcap"))) for _ in range(2)]
    for one in recorders:
        one.warm_up()
    for one in recorders:
        one.on_message("odometry", Serialized("/odometry", 0, topics.encode("odometry", state(0)), topics.message_type("odometry")))
        one.close()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["f.1.mcap", "f.mcap"]
    assert all(len(RecordedFlight(file).values("odometry")) == 1 for file in tmp_path.iterdir())


def test_a_recorder_that_is_started_again_keeps_what_there_is(tmp_path):
    for name in ("f.mcap", "f.1.mcap", "f.2.mcap"):
        recording = Recording(tmp_path / "f.mcap")
        recording.fly(range(10))
        recording.recorder.close()
        assert [line.text.endswith(f"recording to {tmp_path / name}") for line in recording.lines] == [
            True] * (name != "f.mcap")
        assert len(RecordedFlight(tmp_path / name).values("odometry")) == 10
    assert len(RecordedFlight(tmp_path / "f.mcap").values("odometry")) == 10


@pytest.mark.parametrize("outcome, cause, words", [
    ("perched", "perched", "perched"), ("perched", "came_off", "perched (came_off: "), ("missed", "missed_pad", "missed (missed_pad: "),
    ("failed", "lost_track", "failed"), ("cancelled", "timeout", "cancelled")])
def test_a_heading_has_the_cause_where_the_truth_says_more_than_the_mission(outcome, cause, words):
    said = outcome_text({"outcome": outcome, "cause": cause})
    assert said.startswith(words) and ("(" in said) == ("(" in words)
