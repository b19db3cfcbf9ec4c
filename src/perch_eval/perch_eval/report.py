"""`report.json` and `report.html` of one flight."""

from __future__ import annotations

import html
import json
import math
import re
from pathlib import Path
from typing import Any

from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval import plots
from perch_eval.flight import Flight
from perch_eval.inspection.figures import metrics_figure, paths_figure
from perch_eval.inspection.measures import Inspected
from perch_eval.inspection.recorded import recorded
from perch_eval.loop_plots import inner_loop_figure
from perch_eval.margins import limits, margins
from perch_eval.metrics import contact_report, diagnostics, flight_metrics, missed_deadlines, node_durations, perch_window, rates
from perch_eval.goal import SUCCESSES
from perch_eval.replay.scene import View
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.turnable import AFTER, BEFORE, Shown, turnable
from perch_sim.scenario import Scenario

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: 3px 12px 3px 0; text-align: left; vertical-align: top; }
td { overflow-wrap: anywhere; } th { white-space: nowrap; padding-right: 20px; }
th { font-weight: 600; } .good { color: #17692b; } .bad { color: #a11; } img { max-width: 100%; }
.frames { display: grid; grid-template-columns: repeat(4, 1fr); gap: 10px; } figure { margin: 0; } figcaption { font-size: 12px; color: #555; }
code { background: #f4f4f4; padding: 0 3px; }
"""


def build_report(folder: Path, scenario: Scenario, seed: int, outcome: str, message: str, wall_time: float,
                 end_time: float, start_time: float | None = None) -> dict[str, Any]:
    """Read `flight.mcap` in `folder` and write `report.json` and `report.html` beside it.

    Args:
        folder: output folder of the flight.
        scenario: what was flown.
        seed: its seed.
        outcome: `perched`, or how it failed (lower-case name of the action's error code).
        message: the mission's own words.
        wall_time: wall-clock duration of the flight [s].
        end_time: simulation time at which the goal ended [s].
        start_time: simulation time at which it was sent [s]; None: the recording begins with it.

    Returns:
        The content of `report.json`; with `unwritten`, the reason, where neither file could be written.
    """
    vehicle = load_vehicle(scenario.vehicle)
    flight = RecordedFlight(folder / "flight.mcap")
    if start_time is None:
        first = flight.values("ground_truth/odometry")
        start_time = first[0][0] if first else end_time
    report: dict[str, Any] = {
        "outcome": outcome, "message": message, "scenario": scenario.name, "vehicle": scenario.vehicle, "seed": seed,
        "simulated_time_s": end_time, "simulated_duration_s": end_time - start_time, "wall_time_s": wall_time,
        "real_time_factor": (end_time - start_time) / wall_time if wall_time > 0 else math.nan,
        **flight_metrics(flight, vehicle, end_time),
        "flight_hash": flight.digest(end_time), "margins": [one.mapping() for one in margins(flight, vehicle, scenario)],
        "rates_hz": rates(flight), "timings_ms": node_durations(flight),
        "missed_deadlines": missed_deadlines(flight), "recording_damage": flight.damage,
    }
    inspection = recorded(flight, scenario)
    if inspection is not None:
        report["inspection"] = {
            "reference_collisions": inspection.reference.collisions, "collisions": inspection.collisions,
            "reference_reprojection_px": inspection.reference.reprojection, "reprojection_px": inspection.flown.reprojection,
            "least_clearance": float(inspection.flown.clearance.min())}
    files = {"report.json": json.dumps(_finite(report), indent=2) + "\n", "report.html": _page(flight, scenario, report, vehicle, inspection)}
    try:
        for name, content in files.items():
            (folder / name).write_text(content)
    except OSError as error:
        for name in files:
            (folder / name).unlink(missing_ok=True)  # half a report, or one of an earlier flight
        report["unwritten"] = f"{folder}: the report cannot be written: {error.strerror}"
    return report


def _finite(value: Any) -> Any:
    """JSON has no nan: null says that a figure could not be had."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


UNITS = {"us": "us", "ms": "ms", "s": "s", "hz": "Hz", "deg": "deg", "percent": "%"}  # in names of diagnostics
_UNIT = re.compile(rf"_({'|'.join(UNITS)})(?=_|$)")
COMMANDS = ("disarm", "arm", "hover", "land", "attached", "kill")  # perch_msgs/ControllerCommand


def _timeline(flight: Flight) -> list[tuple[float, str]]:
    rows = [(t, f"mission orders {COMMANDS[c.command]}: {c.reason}") for t, c in flight.values("controller/command")]
    for _, order in flight.values("trajectory"):
        kind = {0: "move", 1: "perch", 2: "landing", 3: "powerline perch with recovery"}[order.at_end]
        rows.append((order.trajectory.start_time, f"trajectory {order.id} ({kind}) starts, {order.trajectory.duration:.2f} s"))
    last = None
    for t, status in flight.values("controller/status"):
        if status.message and status.message != last:
            rows.append((t, f"controller says: {status.message}"))
            last = status.message
    states = {0: "free", 1: "attached to", 2: "bounced off", 3: "collided with", 4: "on"}
    for t, contact in flight.values("contact"):
        rows.append((t, f"contact (truth): {states[contact.state]} {contact.body}" + (f", {contact.reason}" if contact.reason else "")))
    return sorted(rows)


def _row(name: str, value: Any) -> str:
    return f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>"


def _with_unit(key: str, value: float) -> str:
    """A figure of a node's diagnostics, whose unit is a part of its name, in words."""
    unit = _UNIT.search(key)
    return f"{_UNIT.sub('', key).replace('_', ' ')} {value:.4g}{f' {UNITS[unit[1]]}' if unit else ''}"


def _vector(values: Any, scale: float = 1.0, unit: str = "") -> str:
    if values is None:
        return "not measured"
    return ", ".join("-" if v is None or not math.isfinite(v) else f"{scale * v:.1f}" for v in values) + f" {unit}"


def inspection_words(figures: dict[str, Any]) -> str:
    """What came of an inspection, in a line."""
    return (f"{figures['collisions']} collisions ({figures['reference_collisions']} of the reference); mean reprojection error "
            f"{figures['reprojection_px']:.0f} px ({figures['reference_reprojection_px']:.0f} px of the reference); "
            f"least scaled clearance {figures['least_clearance']:.2f}")


def _turnable(flight: Flight, vehicle: Vehicle, name: str) -> str:
    """The flight in 3-D, around the perch if there is one."""
    try:
        view = View.of(flight)
    except LookupError:
        return "not recorded"
    first, last = float(view.truth.t[0]), float(view.truth.t[-1])
    window = perch_window(flight)
    start, end = (max(first, window[0] - BEFORE), min(last, window[1] + AFTER)) if window else (first, last)
    return turnable([Shown(name, plots.TRUTH, view, vehicle, start, end, 0.0)])


def _page(flight: Flight, scenario: Scenario, report: dict[str, Any], vehicle: Vehicle, inspection: Inspected | None) -> str:
    good = report["outcome"] in SUCCESSES
    contact = contact_report(flight)
    rows = [
        _row("scenario", f"{scenario.name}: {scenario.description}"), _row("seed", report["seed"]),
        _row("message", report["message"]),
        _row("tracking RMSE x, y, z", _vector(report.get("tracking_rmse_m"), 100, "cm")),
        _row("estimation RMSE x, y, z", _vector(report.get("estimation_rmse_m"), 100, "cm")),
        _row("largest body rate", f"{report.get('max_body_rate_deg_s', math.nan):.0f} deg/s"),
        _row("largest acceleration", f"{report.get('max_acceleration_m_s2', math.nan):.1f} m/s^2"),
        _row("real-time factor", f"{report['real_time_factor']:.2f}: {report['simulated_duration_s']:.2f} s of simulated time "
                                 f"in {report['wall_time_s']:.2f} s"),
        _row("ended at", f"{report['simulated_time_s']:.2f} s of simulated time"),
        _row("flight hash", report["flight_hash"][:16]),
    ]
    if flight.damage:
        rows.insert(3, _row("recording", f"cut off or damaged ({flight.damage}): the figures are of what can be read"))
    if contact:
        rows.insert(3, _row("contact", f"{contact['state']} at {contact['time']:.3f} s: {contact['normal_speed_m_s']:.2f} m/s normal, "
                                       f"{contact['tangential_speed_m_s']:.2f} m/s tangential, tilt error {contact['tilt_error_deg']:.1f} deg, "
                                       f"{100 * contact['offset_m']:.1f} cm from the centre {contact['reason']}"))
    if report.get("target_error"):
        e = report["target_error"]
        rows.insert(3, _row("target error", f"{100 * e['position_m']:.1f} cm, {e['attitude_deg']:.2f} deg"))
    if inspection is not None:
        rows.insert(3, _row("inspection", inspection_words(report["inspection"])))
    images = [("Tracking and estimation through the perch", plots.tracking_figure(flight)),
              ("Path, seen from the side", plots.path_figure(flight)),
              ("Body rates and tilt", plots.rates_figure(flight)),
              ("Thrust against its bounds", plots.thrust_figure(flight, vehicle)),
              ("The inner loop: commanded, measured, and by the vehicle file's model", inner_loop_figure(flight, vehicle)),
              ("Estimation error over the flight", plots.error_figure(flight))] if flight.states("ground_truth/odometry") else []
    if inspection is not None:
        images = [("Reference and flown path", plots.encode(paths_figure(inspection))),
                  ("Clearance, reprojection error and visibility of the watched line", plots.encode(metrics_figure(inspection))), *images]
    window = perch_window(flight)
    moments = [window[0], window[0] + 0.6 * (window[1] - window[0]), window[1] - 0.05, window[1] + 0.3] if window else []
    frames = "".join(f'<figure><img src="data:image/jpeg;base64,{data}"><figcaption>{caption}</figcaption></figure>'
                     for caption, data in plots.camera_frames(flight, moments))
    timeline = "".join(f"<tr><td>{t:.3f} s</td><td>{html.escape(text)}</td></tr>" for t, text in _timeline(flight))
    nodes = "".join(_row(node, ", ".join(_with_unit(k, v) for k, v in reports[-1].items()))
                    for node, reports in diagnostics(flight).items())
    timings = "".join(_row(node, ", ".join(f"{k.replace('_ms', '').replace('_', ' ')} {v:.3g} ms" for k, v in values.items()))
                      for node, values in report["timings_ms"].items())
    hz = "".join(_row(topic, f"{rate:.1f} Hz") for topic, rate in report["rates_hz"].items())
    kept = "".join(_row(m["name"], f"{m['value']:.2f} {m['unit']} ({limits(m)}): {m['left']:+.2f} left") for m in report["margins"])
    figures = "".join(f'<h2>{title}</h2><img alt="{title}" src="data:image/png;base64,{data}">' for title, data in images if data)
    return (f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{scenario.name}, seed {report["seed"]}</title><style>{STYLE}</style>'
            f'<h1>{html.escape(scenario.name)}, seed {report["seed"]}: <span class="{"good" if good else "bad"}">{report["outcome"]}</span></h1>'
            f'<table>{"".join(rows)}</table><h2>Margins</h2><table>{kept or "no perch was planned"}</table>'
            f'<h2>Timeline</h2><table>{timeline}</table><h2>Flight in 3-D</h2>{_turnable(flight, vehicle, scenario.name)}{figures}'
            f'<h2>What the cameras saw</h2><div class="frames">{frames or "no images recorded"}</div>'
            f"<h2>Rates</h2><table>{hz}</table><h2>Durations that the nodes measured</h2>"
            f"<table>{timings}</table><h2>Last diagnostics</h2><table>{nodes}</table></html>\n")
