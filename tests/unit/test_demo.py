"""`demo.py`: what becomes of an earlier flight in the same folder."""

from __future__ import annotations

import os

import pytest

from perch_core.errors import PerchError
from perch_eval import demo
from perch_eval.demo import _replaced


def test_a_flight_that_is_refused_leaves_the_earlier_recording(tmp_path):
    recording = tmp_path / "flight.mcap"
    recording.write_text("earlier")
    with pytest.raises(PerchError), _replaced(recording):
        recording.write_text("begun")
        raise PerchError("a parameter is refused")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["earlier"]


def test_an_interrupted_flight_leaves_what_it_has_recorded_alone(tmp_path):
    recording = tmp_path / "flight.mcap"
    recording.write_text("earlier")
    with pytest.raises(KeyboardInterrupt), _replaced(recording):
        recording.write_text("begun")
        raise KeyboardInterrupt
    assert [path.read_text() for path in tmp_path.iterdir()] == ["begun"]


def test_a_flight_that_is_interrupted_before_it_records_leaves_the_earlier_recording(tmp_path):
    recording = tmp_path / "flight.mcap"
    recording.write_text("earlier")
    with pytest.raises(KeyboardInterrupt), _replaced(recording):
        raise KeyboardInterrupt
    assert [path.read_text() for path in tmp_path.iterdir()] == ["earlier"]


@pytest.mark.parametrize("records", [True, False])
def test_a_flight_that_ends_leaves_its_own_recording_or_none(tmp_path, records):
    recording = tmp_path / "flight.mcap"
    recording.write_text("earlier")
    with _replaced(recording):
        assert not recording.exists()
        if records:
            recording.write_text("new")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["new"] * records


def test_flights_into_many_folders_leave_no_files_open(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise PerchError("no programs")

    monkeypatch.setattr(demo, "check_flight", lambda *_: None)
    monkeypatch.setattr(demo, "programs", refused)
    before = len(os.listdir("/proc/self/fd"))
    for k in range(20):
        with pytest.raises(PerchError, match="no programs"):
            demo.fly("surface_90", 1, tmp_path / str(k))
    assert len(os.listdir("/proc/self/fd")) == before
