"""Reading a recorded flight for display, with its report and its vehicle."""

from __future__ import annotations

import json
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from perch_core.errors import ConfigError, PerchError
from perch_core.urdf import urdf
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.ros.recorded_flight import RecordedFlight


def read_flight(path: Path, namespace: str = "") -> RecordedFlight:
    """Read the flight of a file, or of the `flight.mcap` in a folder; a truncated or damaged file is read as far as possible, with a
    warning.

    Raises:
        PerchError: no such recording.
    """
    path = path / "flight.mcap" if path.is_dir() else path
    if not path.is_file():
        raise PerchError(f"{path}: no such recording")
    flight = RecordedFlight(path, namespace)
    if flight.damage:
        print(f"warning: {path} is not read as a whole: {flight.damage}", file=sys.stderr)
    return flight


def read_report(flight: RecordedFlight) -> dict[str, Any]:
    """Return the `report.json` beside the recording; empty if there is none or, with a warning, if it is of another flight.

    Raises:
        PerchError: the file cannot be read or is not a report.
    """
    path = Path(flight.source).with_name("report.json")
    try:
        report = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise PerchError(f"{path}: cannot be read: {error}") from None
    if not isinstance(report, dict):
        raise PerchError(f"{path}: is not a report")
    if report.get("flight_hash") != flight.digest(report.get("simulated_time_s") or 0.0):
        print(f"warning: {path} is not the report of {flight.source}, and is not used", file=sys.stderr)
        return {}
    return report


def identify_vehicle(flight: RecordedFlight, report: dict[str, Any], given: str = "") -> Vehicle | None:
    """Return the vehicle that flew: the given one, that of the report or of `robot_description`; None, with a warning: unknown.

    Raises:
        ConfigError: the given vehicle does not exist or is refused.
    """
    if given:
        return load_vehicle(given)
    with suppress(ConfigError):
        if report.get("vehicle"):
            return load_vehicle(report["vehicle"])
    for _, text in flight.values("robot_description")[-1:]:
        name = re.search(r'<robot name="([^"]+)"', text)
        with suppress(ConfigError):
            if name and urdf(vehicle := load_vehicle(name[1])) == text:
                return vehicle
    print(f"warning: {flight.source}: the vehicle is not known: drawn as snapdragon, without its thrust; give --vehicle", file=sys.stderr)
    return None
