"""Replays of recorded flights: the recording written from a trace, its animation, its plots, and refusals."""

import dataclasses

import cv2
import numpy as np
import pytest
from PIL import Image

from perch_core.scenario import load_scenario
from perch_eval.flight import Flight
from perch_eval.in_process import fly
from perch_eval.in_process.recording import TracedFlight, write
from perch_eval.in_process.trace import TRUTH
from perch_eval.mcap_log import read
from perch_eval.metrics import flight_metrics
from perch_core.vehicle import load_vehicle
from perch_eval.replay.command import main


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A take-off and the first two seconds of flight, recorded from a trace."""
    scenario = dataclasses.replace(load_scenario("surface_90"), time_limit=2.0)
    trace = fly(scenario, 1)
    path = tmp_path_factory.mktemp("replay") / "flight.mcap"
    write(trace, path)
    return path, trace


def test_a_trace_is_read_back_as_it_was_flown(recorded):
    path, trace = recorded
    flight, traced = Flight(path), TracedFlight(trace)
    states = flight.states("ground_truth/odometry")
    assert np.allclose(states.p, trace.part(TRUTH)[:, 0:3], atol=1e-12)
    assert np.allclose(states.v, trace.part(TRUTH)[:, 7:10], atol=1e-9)
    assert [m.state for _, m in flight.messages("contact")] == [int(c.state) for c in trace.contacts]
    vehicle = load_vehicle("snapdragon")
    from_file, from_trace = (flight_metrics(f, vehicle, trace.end_time) for f in (flight, traced))
    assert from_file["estimation_rmse_m"] == pytest.approx(from_trace["estimation_rmse_m"], rel=1e-6)
    assert from_file["max_body_rate_deg_s"] == pytest.approx(from_trace["max_body_rate_deg_s"], rel=1e-9)


def test_an_animation_has_a_frame_for_each_moment(recorded, tmp_path):
    path, _ = recorded
    gif = tmp_path / "f.gif"
    assert main([str(path), "--from", "1.2", "--to", "1.6", "--fps", "10", "--out", str(gif)]) == 0
    with Image.open(gif) as image:
        assert image.n_frames == 4


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
    path, _ = recorded
    whole, damaged = path.read_bytes(), tmp_path / "damaged.mcap"
    middle = len(whole) // 2
    damaged.write_bytes(whole[:middle] + bytes(4096) + whole[middle + 4096:])
    count = len(Flight(path).messages("odometry"))
    assert 0 < len(Flight(damaged).messages("odometry")) < count
    damaged.write_bytes(whole[:middle])
    assert 0 < len(Flight(damaged).messages("odometry")) < count


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
    assert Flight(path).damage == ""
    assert main([str(damaged)]) == 2
    assert "cut off or damaged" in capsys.readouterr().err


def test_no_recording_is_the_callers_mistake(tmp_path, capsys):
    assert main([str(tmp_path / "none.mcap")]) == 2
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert main([str(tmp_path / "empty.mcap")]) == 2
    assert "ground_truth/odometry" in capsys.readouterr().err
