"""Two recorded flights side by side, on one page: paths, errors, thrust and rates, margins, figures."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from perch_core.errors import PerchError
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.arguments import exit_code
from perch_eval.flight import Flight, States
from perch_eval.margins import limits, margins
from perch_eval.metrics import flight_metrics, perch_window, thrust_history, tilt_degrees
from perch_eval.page import image, page, section, table
from perch_eval.plots import LIMIT, encode
from perch_eval.replay.scene import View
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.turnable import AFTER, BEFORE, Shown, turnable

COLOURS = ("#1f77b4", "#d95f02")
SAID = ("outcome", "scenario", "vehicle", "seed", "message")  # words of a report
EXAMPLES = """examples:
  python3 scripts/compare.py out/flight.mcap /tmp/flight/flight.mcap   page compare.html in this folder
  python3 scripts/compare.py before after --out before_after.html      folders of demo.py, with flight.mcap and report.json
  python3 scripts/compare.py two.mcap two.mcap --namespace /quad1 /quad2

exit code: 0 written, 2 the caller's mistake (no such recording, nothing in it)"""


@dataclass(frozen=True)
class Side:
    """One of the two flights.

    Attributes:
        name: on the page.
        flight, view: what was recorded.
        vehicle: that flew.
        report: its `report.json`, or what the recording gives of it.
        start, end: of the perch, or of the recording where there is none [s].
        last: of the recording [s].
    """

    name: str
    flight: Flight
    view: View
    vehicle: Vehicle
    report: dict[str, Any]
    start: float
    end: float
    last: float


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = argparse.ArgumentParser(prog="compare.py", description=__doc__, epilog=EXAMPLES,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    out.add_argument("flights", type=Path, nargs=2, metavar="FLIGHT",
                     help="recording, or folder with flight.mcap and report.json")
    out.add_argument("--out", type=Path, default=Path("compare.html"), metavar="FILE",
                     help="page to write (default: %(default)s)")
    out.add_argument("--names", nargs=2, metavar=("A", "B"), help="names of the flights on the page (default: the paths)")
    out.add_argument("--vehicle", default="", help="vehicle that flew (default: that of the report, or snapdragon)")
    out.add_argument("--namespace", nargs=2, default=("", ""), metavar=("A", "B"),
                     help="namespaces of the vehicles, where several were recorded")
    return out


def main(arguments: list[str] | None = None) -> int:
    """Entry point; 0 written, 2 the caller's mistake."""
    args = parser().parse_args(arguments)

    def work() -> int:
        names = args.names or [f"{path}{namespace}" for path, namespace in zip(args.flights, args.namespace)]
        sides = [read(*each, args.vehicle) for each in zip(names, args.flights, args.namespace)]
        page = compare(*sides)
        try:
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(page)
        except OSError as error:
            raise PerchError(f"--out {args.out}: cannot be written: {error.strerror}") from None
        print(f"page: {args.out}")
        return 0

    return exit_code(work)


def read(name: str, path: Path, namespace: str = "", vehicle: str = "") -> Side:
    """A recorded flight with its report, where there is one.

    Args:
        name: on the page.
        path: of the recording, or of its folder.
        namespace: of the vehicle, where several were recorded.
        vehicle: name or file; empty: as the report says, or `snapdragon`.

    Raises:
        PerchError: no recording, or nothing in it.
    """
    file = path / "flight.mcap" if path.is_dir() else path
    if not file.is_file():
        raise PerchError(f"{file}: no such recording")
    flight = RecordedFlight(file, namespace)
    try:
        view = View.of(flight)
    except LookupError as error:
        raise PerchError(f"{file}: {error}") from None
    report = _report(file.with_name("report.json"))
    model = load_vehicle(vehicle or report.get("vehicle") or "snapdragon")
    last = float(view.truth.t[-1])
    start, end = perch_window(flight) or (float(view.truth.t[0]), last)
    until = report.get("simulated_time_s") or last
    report = {**report, **flight_metrics(flight, model, until), "flight_hash": flight.digest(until)}
    report.setdefault("margins", [one.mapping() for one in margins(flight, model)])
    return Side(name, flight, view, model, report, start, end, last)


def _report(path: Path) -> dict[str, Any]:
    """What a report says; nothing where there is none.

    Raises:
        PerchError: it is no report.
    """
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise PerchError(f"{path}: cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise PerchError(f"{path}: is not a report")
    return content


def compare(a: Side, b: Side) -> str:
    """The page."""
    sides = (a, b)
    same = a.report["flight_hash"] == b.report["flight_hash"]
    verdict = "The two are the same flight, to the last bit." if same else "The two are different flights."
    shown = [Shown(side.name, colour, side.view, side.vehicle, max(float(side.view.truth.t[0]), side.start - BEFORE),
                   min(side.last, side.end + AFTER), side.start) for side, colour in zip(sides, COLOURS)]
    figures = [("Path, seen from the side", _path), ("Position", _positions), ("Errors", _errors), ("Rates and tilt", _rates),
               ("Collective thrust, and its bounds", _thrust)]
    return page(f"{a.name} and {b.name}", f"<p>{verdict} Times count from the start of the perch.</p>",
                section("Figures", _table(sides)), section("Margins", _margin_table(sides), "No perch was planned."),
                section("Flight in 3-D", turnable(shown)), *(section(name, image(encode(draw(sides)), name)) for name, draw in figures))


# -- tables ----------------------------------------------------------------------------------------------------------

def figures_of(report: dict[str, Any]) -> dict[tuple[str, str], float]:
    """(name, unit) -> figure of a report, as far as it has them."""
    found: dict[tuple[str, str], float | None] = {}
    for key, name in (("tracking_rmse_m", "tracking RMSE"), ("estimation_rmse_m", "estimation RMSE")):
        for axis, value in zip("xyz", report.get(key) or ()):
            found[f"{name} {axis}", "cm"] = 100.0 * value
    found["largest body rate", "deg/s"] = report.get("max_body_rate_deg_s")
    found["largest acceleration", "m/s^2"] = report.get("max_acceleration_m_s2")
    if report.get("perch_planned"):
        found["duration of the perch", "s"] = report["window_s"][1] - report["window_s"][0]
    contact, target = report.get("contact") or {}, report.get("target_error") or {}
    found["normal speed at contact", "m/s"] = contact.get("normal_speed_m_s")
    found["tangential speed at contact", "m/s"] = contact.get("tangential_speed_m_s")
    found["tilt error at contact", "deg"] = contact.get("tilt_error_deg")
    found["offset at contact", "cm"] = None if contact.get("offset_m") is None else 100.0 * contact["offset_m"]
    found["target error, position", "cm"] = None if target.get("position_m") is None else 100.0 * target["position_m"]
    found["target error, attitude", "deg"] = target.get("attitude_deg")
    return {key: value for key, value in found.items() if value is not None and math.isfinite(value)}


def _table(sides: Sequence[Side]) -> str:
    a, b = (figures_of(side.report) for side in sides)
    rows = [(key, *(str(side.report.get(key, "-")) for side in sides), "")
            for key in SAID if any(key in side.report for side in sides)]
    rows.append(("flight hash", *(side.report["flight_hash"][:16] for side in sides), ""))
    for name, unit in dict.fromkeys([*a, *b]):
        one, other = a.get((name, unit)), b.get((name, unit))
        difference = f"{other - one:+.2f}" if one is not None and other is not None else ""
        rows.append((f"{name} [{unit}]", *("-" if value is None else f"{value:.2f}" for value in (one, other)), difference))
    return table(rows, ("", *(side.name for side in sides), "B - A"))


def _margin_table(sides: Sequence[Side]) -> str:
    by_name = [{one["name"]: one for one in side.report["margins"]} for side in sides]
    rows = []
    for name in dict.fromkeys(name for found in by_name for name in found):
        one = next(found[name] for found in by_name if name in found)
        kept = (f"{found[name]['value']:.2f}, {found[name]['left']:+.2f} left" if name in found else "-" for found in by_name)
        rows.append((f"{name} [{one['unit']}]", limits(one), *kept))
    return table(rows, ("", "limits", *(side.name for side in sides))) if rows else ""


# -- pictures --------------------------------------------------------------------------------------------------------

Series = Callable[[Side], tuple[np.ndarray, np.ndarray]]


def _near(side: Side, t: np.ndarray) -> np.ndarray:
    return (t >= side.start - 0.3) & (t <= side.end + 0.7)


def _panels(sides: Sequence[Side], panels: Sequence[tuple[str, Series]], rows: int, columns: int,
            bounds: Sequence[float] = ()) -> Any:
    """A figure with a line of each side in each panel, over the time since the perch began."""
    figure, grid = plt.subplots(rows, columns, figsize=(12, 2.6 * rows), sharex=True, squeeze=False, layout="constrained")
    for axis, (label, series) in zip(grid.flat, panels):
        for side, colour in zip(sides, COLOURS):
            t, values = series(side)
            keep = _near(side, t)
            axis.plot(t[keep] - side.start, values[keep], color=colour, lw=1.3, label=side.name)
        for bound in bounds:
            axis.axhline(bound, color=LIMIT, lw=0.8, ls="--")
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    for side, colour in zip(sides, COLOURS):
        for axis in grid.flat:
            axis.axvline(side.end - side.start, color=colour, lw=0.8, ls=":")
    grid[0, 0].legend(fontsize=8)
    for axis in grid[-1]:
        axis.set_xlabel("time since the perch began [s]; dotted: its end")
    return figure


def _path(sides: Sequence[Side]) -> Any:
    """Seen across the line from the first side's start to its end."""
    figure, axis = plt.subplots(figsize=(12, 5), layout="constrained")
    first = sides[0].view.truth.at(np.array([sides[0].start, sides[0].end])).p
    along = first[1, :2] - first[0, :2]
    along = along / np.linalg.norm(along) if np.linalg.norm(along) > 1e-6 else np.array([1.0, 0.0])
    for side, colour in zip(sides, COLOURS):
        lines = ((side.view.reference, 0.8, f"{side.name}, reference"), (side.view.truth, 1.8, side.name))
        for states, width, label in lines:
            if states is not None:
                keep = (states.t >= side.start) & (states.t <= side.end)
                axis.plot(states.p[keep, :2] @ along, states.p[keep, 2], color=colour, lw=width, label=label)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel="along the perch [m]", ylabel="z [m]")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure


def _positions(sides: Sequence[Side]) -> Any:
    panels: list[tuple[str, Series]] = [(f"{name} [m]", lambda side, i=i: (side.view.truth.t, side.view.truth.p[:, i]))
                                        for i, name in enumerate("xyz")]
    return _panels(sides, panels, 3, 1)


def _distance(side: Side, states: States | None) -> tuple[np.ndarray, np.ndarray]:
    """From the truth [cm], over time; nothing where there are no states."""
    if states is None:
        return np.empty(0), np.empty(0)
    inside = (states.t >= side.start) & (states.t <= side.end)
    t = states.t[inside]
    return t, 100.0 * np.linalg.norm(states.p[inside] - side.view.truth.at(t).p, axis=1)


def _errors(sides: Sequence[Side]) -> Any:
    return _panels(sides, [("reference - truth [cm]", lambda side: _distance(side, side.view.reference)),
                           ("estimate - truth [cm]", lambda side: _distance(side, side.view.estimate))], 1, 2)


def _rates(sides: Sequence[Side]) -> Any:
    panels: list[tuple[str, Series]] = [
        (f"rate {name} [deg/s]", lambda side, i=i: (side.view.truth.t, np.degrees(side.view.truth.w[:, i])))
        for i, name in enumerate("xyz")]
    panels.append(("tilt of b3 [deg]", lambda side: (side.view.truth.t, tilt_degrees(side.view.truth.q))))
    return _panels(sides, panels, 2, 2)


def _thrust(sides: Sequence[Side]) -> Any:
    bounds = {bound for side in sides for bound in (4 * side.vehicle.thrust_min, 4 * side.vehicle.thrust_max)}
    return _panels(sides, [("reached [N]", lambda side: thrust_history(side.flight, side.vehicle)[:2]),
                           ("commanded [N]", lambda side: thrust_history(side.flight, side.vehicle)[::2])], 1, 2, sorted(bounds))
