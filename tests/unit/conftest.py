"""Recorded flights for the tests of what shows and compares them; what draws and reports is imported where it is used."""

import shutil

import pytest


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """The file and the flight of its values."""
    from unit.recorded_flights import flown, record

    from perch_eval.flight import Flight

    channels, path = flown(), tmp_path_factory.mktemp("replay") / "flight.mcap"
    record(path, channels)
    return path, Flight(channels)


@pytest.fixture(scope="session")
def reported(recorded, tmp_path_factory):
    """The folder of a flight with its report, and what the report gave."""
    from perch_eval.report import build_report
    from perch_sim.scenario import load_scenario

    folder = tmp_path_factory.mktemp("reported")
    shutil.copy(recorded[0], folder)
    return folder, build_report(folder, load_scenario("surface_90"), 3, "perched", "held <by velcro>", 2.0, 4.0)
