"""Two recorded flights side by side, on one page: paths, errors, thrust and rates, margins, figures."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perch_core.vehicle import load_vehicle
from perch_eval import plots
from perch_eval.arguments import command, command_parser, output_file
from perch_eval.flight_view import FlightView
from perch_eval.margins import limits, margins, number
from perch_eval.metrics import FIGURES, figures, flight_metrics
from perch_eval.page import image, page, section, table
from perch_eval.recorded import identify_vehicle, read_flight, read_report
from perch_eval.scene_3d import scene_3d

COLOURS = ("#1f77b4", "#d95f02")
REPORT_FIELDS = ("outcome", "scenario", "vehicle", "seed", "date", "commit", "digest", "message")  # shown as text
EXAMPLES = """examples:
  python3 scripts/compare.py out/flight.mcap /tmp/flight/flight.mcap   page compare.html in this folder
  python3 scripts/compare.py before after --out before_after.html      folders of demo.py, with flight.mcap and report.json
  python3 scripts/compare.py two.mcap two.mcap --namespace /quad1 /quad2

exit code: 0 written, 2 invalid input (no such recording, nothing in it)"""


@dataclass(frozen=True)
class Side:
    """One of the two flights: its end [s], the recording, figures from it and from its `report.json`, and whether the vehicle is known."""

    until: float
    view: FlightView
    report: dict[str, Any]
    known: bool

    def digest(self, until: float) -> str:
        """Return the flight's hash up to a time [s]; that up to its end is known."""
        return self.report["flight_hash"] if until == self.until else self.view.flight.digest(until)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("compare.py", __doc__, EXAMPLES)
    out.add_argument("flights", type=Path, nargs=2, metavar="FLIGHT",
                     help="recording, or folder with flight.mcap and report.json")
    out.add_argument("--out", type=Path, default=Path("compare.html"), metavar="FILE",
                     help="page to write (default: %(default)s)")
    out.add_argument("--names", nargs=2, metavar=("A", "B"), help="names of the flights on the page (default: the paths)")
    out.add_argument("--vehicle", default="", help="vehicle that flew (default: that of the report, or of the recording)")
    out.add_argument("--namespace", nargs=2, default=("", ""), metavar=("A", "B"),
                     help="namespaces of the vehicles, where several were recorded")
    return out


def _write(args: argparse.Namespace) -> int:
    names = args.names or [f"{path}{namespace}" for path, namespace in zip(args.flights, args.namespace)]
    sides = [read(*each, vehicle=args.vehicle) for each in zip(names, COLOURS, args.flights, args.namespace)]
    page = compare(*sides)
    with output_file(args.out) as draft:
        draft.write_text(page)
    print(f"page: {args.out}")
    return 0


def read(name: str, colour: str, path: Path, namespace: str = "", vehicle: str = "") -> Side:
    """Read a recorded flight and, if there is one, its report.

    Args:
        name, colour: on the page.
        path: of the recording, or of its folder.
        namespace: of the vehicle, where several were recorded.
        vehicle: name or file; empty: that of the report or of the recording.

    Raises:
        PerchError: there is no recording or no true states in it, or report or vehicle cannot be used.
    """
    flight = read_flight(path, namespace)
    flight.known_states("ground_truth/odometry")
    report = read_report(flight)
    identified = identify_vehicle(flight, report, vehicle)
    model = identified or load_vehicle("snapdragon")
    view = FlightView.from_flight(flight, model, name, colour)
    until = report.get("simulated_time_s") or float(view.truth.t[-1])
    flight_hash = report["flight_hash"] if report.get("simulated_time_s") else flight.digest(until)
    report = {**report, **flight_metrics(flight, until), "flight_hash": flight_hash}
    found = {one["name"]: one for one in report.get("margins", ()) if one.get("left") is not None}
    found |= {one["name"]: one for one in margins(flight, model) if identified is not None}
    return Side(until, view, report | {"margins": list(found.values())}, identified is not None)


def compare(a: Side, b: Side) -> str:
    """Return the page as HTML."""
    sides, views = (a, b), (a.view, b.view)
    until = min(a.until, b.until)
    same = a.digest(until) == b.digest(until)
    verdict = "The two are the same flight, to the last bit." if same else "The two are different flights."
    drawn = {"Path, side view": plots.path_figure, "Position and velocity": plots.tracking_figure, "Errors": plots.distance_figure,
               "Rates and tilt": plots.rates_figure}
    if a.known and b.known:
        drawn["Collective thrust, and its bounds"] = plots.thrust_figure
    return page(f"{a.view.name} and {b.view.name}", f"<p>{verdict} Times count from the start of the perch.</p>",
                section("Figures", _table(sides)), section("Margins", _margin_table(sides), "No perch was planned."),
                section("Flight in 3-D", scene_3d(views)), *(section(name, image(draw(*views), name)) for name, draw in drawn.items()))


def _table(sides: Sequence[Side]) -> str:
    a, b = (figures(side.report, math.nan) for side in sides)
    rows = [(key, *(str(side.report.get(key, "-")) for side in sides), "")
            for key in REPORT_FIELDS if any(key in side.report for side in sides)]
    rows.append(("flight hash", *(side.report["flight_hash"][:16] for side in sides), ""))
    for name, (title, unit, factor) in FIGURES.items():
        one, other = a.get(name), b.get(name)
        if one is not None or other is not None:
            difference = f"{factor * (other - one):+.2f}" if one is not None and other is not None else ""
            rows.append((f"{title} [{unit}]", *("-" if value is None else f"{factor * value:.2f}" for value in (one, other)), difference))
    return table(rows, ("", *(side.view.name for side in sides), "B - A"))


def _margin_table(sides: Sequence[Side]) -> str:
    by_name = [{one["name"]: one for one in side.report["margins"]} for side in sides]
    rows = []
    for name in dict.fromkeys(name for found in by_name for name in found):
        both = [found[name] for found in by_name if name in found]
        kept = (f"{number(found[name]['value'])}, {number(found[name]['left'], '+')} left" if name in found else "-" for found in by_name)
        rows.append((f"{name} [{both[0]['unit']}]", " / ".join(dict.fromkeys(map(limits, both))), *kept))
    return table(rows, ("", "limits", *(side.view.name for side in sides))) if rows else ""


main = command(parser, _write)
