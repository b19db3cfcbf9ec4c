"""`report.json` and `report.html` of one flight."""

from __future__ import annotations

import math
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from perch_core.errors import PerchError
from perch_core.json_values import to_text
from perch_core.values import Command
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval import plots
from perch_eval.camera_clip import clip
from perch_eval.campaign.causes import MEANING, SUCCESS, cause_of
from perch_eval.evaluation.document import machine
from perch_eval.flight import Flight
from perch_eval.flight_view import FlightView
from perch_eval.goal import SUCCESSES
from perch_eval.identification.responses import inner_loop_figure
from perch_eval.inspection.figures import metrics_figure, paths_figure
from perch_eval.inspection.measures import InspectionResult, recorded_inspection
from perch_eval.margins import margin_text, margins
from perch_eval.metrics import DURATION, diagnostics, flight_metrics, missed_deadlines, node_durations, rates
from perch_eval.page import Html, image, in_words, page, section, table, text
from perch_eval.revision import code_version, command_line
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.scene_3d import scene_3d
from perch_sim.scenario import Scenario


def build_report(folder: Path, scenario: Scenario, seed: int, outcome: str, message: str, wall_time: float,
                 end_time: float, start_time: float | None = None) -> dict[str, Any]:
    """Read `flight.mcap` in `folder`, of a flight that has just ended, and write `report.json` and `report.html` beside it.

    Args:
        folder: output folder of the flight.
        scenario: the scenario flown.
        seed: its seed.
        outcome: `perched`, or how it failed (lower-case name of the action's error code).
        message: of the mission.
        wall_time: wall-clock duration of the flight [s].
        end_time: simulation time at which the goal ended [s].
        start_time: simulation time at which the goal was sent [s]; None: the start of the recording.

    Returns:
        The content of `report.json`; with the reason as `unwritten` if the files could not be written.
    """
    vehicle = load_vehicle(scenario.vehicle)
    flight = RecordedFlight(folder / "flight.mcap")
    if start_time is None:
        first = flight.values("ground_truth/odometry")
        start_time = first[0][0] if first else end_time
    report: dict[str, Any] = {
        "outcome": outcome, "cause": cause_of(outcome, [contact for _, contact in flight.values("contact")], scenario),
        "message": message, "scenario": scenario.name, "vehicle": scenario.vehicle, "seed": seed,
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", **code_version(), "command": command_line(), "machine": machine(),
        "simulated_time_s": end_time, "simulated_duration_s": end_time - start_time, "wall_time_s": wall_time,
        "real_time_factor": (end_time - start_time) / wall_time if wall_time > 0 else math.nan,
        **flight_metrics(flight, end_time),
        "flight_hash": flight.digest(end_time), "margins": margins(flight, vehicle, scenario),
        "rates_hz": rates(flight), "timings_ms": node_durations(flight),
        "missed_deadlines": missed_deadlines(flight), "recording_damage": flight.damage,
    }
    inspection = recorded_inspection(flight, scenario)
    if inspection is not None:
        report["inspection"] = {
            "reference_collisions": inspection.reference.collisions, "collisions": inspection.collisions,
            "reference_reprojection_px": inspection.reference.reprojection, "reprojection_px": inspection.flown.reprojection,
            "least_clearance": float(inspection.flown.clearance.min())}
    files = {"report.json": to_text(report), "report.html": _page(flight, scenario, report, vehicle, inspection)}
    try:
        for name, content in files.items():
            (folder / name).write_text(content)
    except OSError as error:
        for name in files:
            (folder / name).unlink(missing_ok=True)  # half a report, or one of an earlier flight
        report["unwritten"] = f"{folder}: the report cannot be written: {error.strerror}"
    return report


WHOLE_FLIGHT = ("time_s", "real_time_factor")  # diagnostics that the report has elsewhere


def _timeline(flight: Flight) -> list[tuple[float, str]]:
    commands = {one.value: one.name.lower() for one in Command}  # of any node: the number if it is unknown
    rows = [(t, f"mission commands {commands.get(c.command, c.command)}: {c.reason}") for t, c in flight.values("controller/command")]
    started = set()
    for _, order in flight.values("trajectory"):
        kind = {0: "move", 1: "perch", 2: "landing", 3: "powerline perch with recovery"}[order.at_end]
        rest = order.trajectory.duration - (order.contact_after or order.trajectory.duration)
        recovery = f", of which {rest:.2f} s are recovery" if rest > 0.0 else ""
        verb = "is re-planned, what remains takes" if order.id in started else "starts, takes"
        started.add(order.id)
        rows.append((order.trajectory.start_time, f"trajectory {order.id} ({kind}) {verb} {order.trajectory.duration:.2f} s{recovery}"))
    last = None
    for t, status in flight.values("controller/status"):
        if status.message and status.message != last:
            rows.append((t, f"controller: {status.message}"))
            last = status.message
    states = {0: "leaves", 1: "attached to", 2: "bounced off", 3: "collided with", 4: "on"}
    for t, contact in flight.values("contact"):
        rows.append((t, f"contact (truth): {states.get(contact.state, contact.state)} {contact.body}" + (f", {contact.reason}" if contact.reason else "")))
    return sorted(rows)


def last_diagnostics(flight: Flight) -> list[tuple[str, str]]:
    """Return the last diagnostics of each node in words, without what the page has for the whole flight: durations, the vehicle's time
    and its real-time factor. Nodes that report nothing else are left out."""
    rows = [(node, ", ".join(" ".join(in_words(k, v)) for k, v in reports[-1].items() if k not in WHOLE_FLIGHT and not DURATION.search(k)))
            for node, reports in diagnostics(flight).items()]
    return [(node, words) for node, words in rows if words]


def _centimetres(values: Any) -> str:
    if values is None:
        return "not measured"
    return ", ".join("-" if v is None or not math.isfinite(v) else f"{100 * v:.1f}" for v in values) + " cm"


def outcome_text(report: dict[str, Any]) -> str:
    """Return the mission's outcome, with the cause, as in campaigns, where the truth says more: a success is one by the truth, too."""
    outcome, cause = report["outcome"], report["cause"]
    return f"{outcome} ({cause}: {MEANING[cause]})" if cause != SUCCESS and outcome in (*SUCCESSES, "missed") else outcome


def summary(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the results of a flight, (name, text), for the page and the terminal: of its perch, if one was planned."""
    rows = [("message", report["message"])]
    if f := report.get("inspection"):
        rows.append(("inspection", f"{f['collisions']} collisions ({f['reference_collisions']} of the reference); mean reprojection error "
                                   f"{f['reprojection_px']:.0f} px ({f['reference_reprojection_px']:.0f} px of the reference); "
                                   f"least scaled clearance {f['least_clearance']:.2f}"))
    if error := report.get("target_error"):
        rows.append(("target error", f"{100 * error['position_m']:.1f} cm, {error['attitude_deg']:.2f} deg"))
    if contact := report.get("contact"):
        rows.append(("contact", f"{contact['state']} at {contact['time']:.3f} s: {contact['normal_speed_m_s']:z.2f} m/s normal, "
                                f"{contact['tangential_speed_m_s']:.2f} m/s tangential, tilt error {contact['tilt_error_deg']:.1f} deg, "
                                f"{100 * contact['offset_m']:.1f} cm from the perch point {contact['reason']}".rstrip()))
    if report["recording_damage"]:
        rows.append(("recording", f"not read as a whole ({report['recording_damage']}): the figures are of what is read"))
    part = "" if report.get("perch_planned", True) else ", of the whole recording"
    for kind in ("tracking", "estimation"):
        share = report.get(f"{kind}_judged", 1.0)
        rows.append((f"{kind} RMSE x, y, z{part}", _centimetres(report.get(f"{kind}_rmse_m")) +
                     (f" (available in {100 * share:.0f} % of the time)" if share < 0.99 else "")))
    return [*rows,
            (f"largest body rate{part}", f"{report.get('max_body_rate_deg_s', math.nan):.0f} deg/s"),
            (f"largest acceleration{part}", f"{report.get('max_acceleration_m_s2', math.nan):.1f} m/s^2"),
            ("real-time factor", f"{report['real_time_factor']:.2f}: {report['simulated_duration_s']:.2f} s of simulated time "
                                 f"in {report['wall_time_s']:.2f} s"),
            ("ended at", f"{report['simulated_time_s']:.2f} s of simulated time"), ("flight hash", report["flight_hash"][:16])]


def _figures(view: FlightView | None, inspection: InspectionResult | None) -> list[tuple[str, Figure | None]]:
    """Titles and figures."""
    figures: list[tuple[str, Figure | None]] = []
    if inspection is not None:
        figures += [("Reference and flown path", paths_figure(inspection)),
                    ("Clearance, reprojection error and visibility of the watched line", metrics_figure(inspection))]
    if view is not None:
        figures += [("Tracking and estimation through the perch", plots.tracking_figure(view)),
                    ("Path, side view", plots.path_figure(view)), ("Body rates and tilt", plots.rates_figure(view)),
                    ("Thrust against its bounds", plots.thrust_figure(view)),
                    ("The inner loop: commanded, measured, and by the vehicle file's model", inner_loop_figure(view.flight, view.vehicle)),
                    ("Estimation error over the flight", plots.error_figure(view))]
    return figures


def _page(flight: Flight, scenario: Scenario, report: dict[str, Any], vehicle: Vehicle, inspection: InspectionResult | None) -> str:
    title = f"{scenario.name}, seed {report['seed']}"
    view = None
    with suppress(PerchError):
        view = FlightView.from_flight(flight, vehicle, scenario.name, until=report["simulated_time_s"])
    good = "good" if report["cause"] == SUCCESS else "bad"
    timings = [(node, ", ".join(" ".join(in_words(k, v)) for k, v in values.items()))
               for node, values in report["timings_ms"].items()]
    margin_rows = [(m["name"], margin_text(m)) for m in report["margins"]]
    flown = [("scenario", f"{scenario.name}: {scenario.description}"), ("vehicle", report["vehicle"]), ("seed", report["seed"]),
             ("date", report["date"]),
             ("commit", report["commit"] + (f" (digest {report['digest']})" if report["digest"] else "")),
             ("made by", f"{report['command']} on {report['machine']}")]
    return page(
        title, table([*flown, *summary(report)]), section("Margins", table(margin_rows), "No perch was planned."),
        section("Timeline", table((f"{t:.3f} s", event) for t, event in _timeline(flight))),
        section("Flight in 3-D", scene_3d([view]) if view is not None else "", "not recorded"),
        section("Camera images", clip(flight, report["simulated_time_s"]), "No images were recorded."),
        *(section(name, image(figure, name)) for name, figure in _figures(view, inspection)),
        section("Rates", table((topic, f"{rate:.1f} Hz") for topic, rate in report["rates_hz"].items())),
        section("Times that the nodes measured", table(timings)), section("Diagnostics of the last second", table(last_diagnostics(flight))),
        heading=Html(f'{text(title)}: <span class="{good}">{text(outcome_text(report))}</span>'))
