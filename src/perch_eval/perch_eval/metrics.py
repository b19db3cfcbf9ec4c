"""The figures of a flight in `report.json`."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from typing import Any

import numpy as np

from perch_control.mission.settings import MissionSettings
from perch_core import so3
from perch_core.values import AtEnd, Contact, seconds
from perch_core.vehicle import Vehicle
from perch_eval.consistency import attitude_error
from perch_eval.flight import GAP, Flight, States
from perch_sim.contact_event import ContactState

FIGURES: dict[str, tuple[str, str, float]] = {
    **{f"{kind}_rmse_m_{axis}": (f"{kind} RMSE {axis}", "cm", 100.0) for kind in ("tracking", "estimation") for axis in "xyz"},
    "max_body_rate_deg_s": ("largest body rate", "deg/s", 1.0), "max_acceleration_m_s2": ("largest acceleration", "m/s^2", 1.0),
    "perch_time_s": ("duration of the perch", "s", 1.0),
    "contact_normal_speed_m_s": ("normal speed at contact", "m/s", 1.0),
    "contact_tangential_speed_m_s": ("tangential speed at contact", "m/s", 1.0),
    "contact_tilt_error_deg": ("tilt error at contact", "deg", 1.0), "contact_offset_m": ("offset at contact", "cm", 100.0),
    "target_error_position_m": ("target error, position", "cm", 100.0), "target_error_attitude_deg": ("target error, attitude", "deg", 1.0),
}
"""Name of a figure, as in `figures` -> title, display unit, factor to that unit."""
MISSION = MissionSettings()
"""Settings of the mission from which the time of a plan's request is known, as shipped."""
DURATION = re.compile(r"_(ms|us)(?=_|$)")
"""Unit in the names of diagnostics that are durations."""


def _rmse(difference: np.ndarray) -> list[float]:
    return np.sqrt(np.mean(difference**2, axis=0)).tolist() if len(difference) else [math.nan] * 3


def perch_window(flight: Flight) -> tuple[float, float] | None:
    """Return start and end of the perch [s]; None if none was planned.

    It is the attempt that made contact, or else the last one, until contact or planned end. A plan that begins after the planned
    contact of the previous one is a new attempt; one that begins earlier replaces it.
    """
    plans = [(begin, begin + order.contact_after) for begin, order in flight.values("trajectory") if order.contact_after is not None]
    if not plans:
        return None
    touch = contact_of(flight)
    contact = math.inf if touch is None else touch[0]
    start, end = math.nan, -math.inf
    for begin, planned in [plan for plan in plans if plan[0] < contact] or plans:
        start, end = begin if begin > end else start, planned
    return start, min(end, contact) if contact > start else end


def contact_of(flight: Flight) -> tuple[float, Contact] | None:
    """Time and event of the contact that ended the perch: the adhesion, or else the first contact after take-off."""
    airborne = False
    first = None
    for t, contact in flight.values("contact"):
        if contact.state == ContactState.ATTACHED:
            return t, contact
        if contact.state == ContactState.NONE:
            airborne = True
        elif airborne and first is None and contact.state in (ContactState.BOUNCED, ContactState.COLLISION):
            first = (t, contact)
    return first


def contact_report(flight: Flight) -> dict[str, Any] | None:
    """Speeds, tilt and offset at the contact, from the truth."""
    touch = contact_of(flight)
    if touch is None:
        return None
    t, contact = touch
    return {"time": t, "state": ContactState(contact.state).name.lower(), "body": contact.body, "normal_speed_m_s": contact.normal_speed,
            "tangential_speed_m_s": contact.tangential_speed, "tilt_error_deg": math.degrees(contact.tilt_error),
            "offset_m": contact.offset, "reason": contact.reason}


def peak_acceleration(truth: States) -> float:
    """Return the largest acceleration of the vehicle's path, averaged over 20 ms [m/s^2]."""
    if len(truth.t) < 12:
        return math.nan
    step = 10
    dv = truth.v[step:] - truth.v[:-step]
    dt = (truth.t[step:] - truth.t[:-step])[:, None]
    return float(np.linalg.norm(dv / dt, axis=1).max())


def flight_metrics(flight: Flight, until: float) -> dict[str, Any]:
    """Return the figures of tracking, estimation, motion, contact and target of a flight.

    Args:
        flight: the recording.
        until: end of the flight [s].
    """
    out: dict[str, Any] = {"contact": contact_report(flight)}
    truth, estimate, reference = (flight.states("ground_truth/odometry"), flight.states("odometry"), flight.reference())
    window = perch_window(flight)
    if truth is None:
        return out
    span = window or (truth.t[0], until)
    inside = (truth.t >= span[0]) & (truth.t <= span[1])
    cut = truth.chosen(inside)
    out["window_s"] = list(span)
    out["perch_planned"] = window is not None
    if len(cut.t) < 2:
        return out
    out["max_body_rate_deg_s"] = math.degrees(float(np.linalg.norm(cut.w, axis=1).max()))
    out["max_acceleration_m_s2"] = peak_acceleration(cut)
    if reference is not None:
        judged = cut.chosen(reference.covers(cut.t))
        out["tracking_judged"] = len(judged.t) / len(cut.t)
        out["tracking_rmse_m"] = _rmse(judged.p - reference.at(judged.t).p)
    if estimate is not None:
        judged = cut.chosen(estimate.covers(cut.t))
        estimated = estimate.at(judged.t)
        out["estimation_judged"] = len(judged.t) / len(cut.t)
        out["estimation_rmse_m"] = _rmse(judged.p - estimated.p)
        out["velocity_rmse_m_s"] = _rmse(judged.v - estimated.v)
        if len(judged.t) and cut.t[-1] - judged.t[-1] <= GAP:
            out["estimation_error_at_end_m"] = (estimated.p[-1] - judged.p[-1]).tolist()
            out["attitude_error_at_end_deg"] = math.degrees(float(np.linalg.norm(attitude_error(judged.q[-1], estimated.q[-1]))))
    out["target_error"] = target_error(flight)
    return out


def figures(report: dict[str, Any], end_time: float) -> dict[str, float | None]:
    """Return the comparable figures of a flight's report by name; None for one that is not available."""
    out: dict[str, float | None] = {"simulated_time_s": end_time, "attitude_error_at_end_deg": report.get("attitude_error_at_end_deg")}
    perch = bool(report.get("perch_planned"))  # else these are of a hover
    out |= {name: report.get(name) for name in ("max_body_rate_deg_s", "max_acceleration_m_s2") if perch}
    for name in ("tracking_rmse_m", "estimation_rmse_m") if perch else ():
        for axis, value in zip("xyz", report.get(name) or ()):
            out[f"{name}_{axis}"] = value
    for part, names in (("contact", ("normal_speed_m_s", "tangential_speed_m_s", "tilt_error_deg", "offset_m", "time")),
                        ("target_error", ("position_m", "attitude_deg"))):
        for name in names:
            out[f"{part}_{name}"] = (report.get(part) or {}).get(name)
    if report.get("window_s") and perch:
        out["perch_time_s"] = report["window_s"][1] - report["window_s"][0]
    return {name: float(v) if v is not None and math.isfinite(v) else None for name, v in out.items()}


def target_error(flight: Flight) -> dict[str, float] | None:
    """Return the error, in map, of the target pose on which the first perch was planned; None if not available.

    It is the newest one when the plan was requested, `mission.plan_lead` before its start.
    """
    true, found = flight.values("ground_truth/target"), flight.values("target/pose")
    plans = [t for t, order in flight.values("trajectory") if order.at_end == AtEnd.CONTACT]
    if not true or not found or not plans:
        return None
    used = [pose for t, pose in found if t <= plans[0] - MISSION.lead(MISSION.planner_latency)] or [found[0][1]]
    pose = used[-1]
    pad = min(true, key=lambda sent: abs(sent[0] - seconds(pose.stamp)))[1]  # it may move
    dp = np.array(pose.p_WS) - np.array(pad.p)
    turn = attitude_error(np.array(pad.q), np.array(pose.q_WS))
    return {"position_m": float(np.linalg.norm(dp)), "attitude_deg": math.degrees(float(np.linalg.norm(turn)))}


def thrust_history(flight: Flight, vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, collective thrust reached and collective thrust commanded (interpolated to the same times) [s, N, N]."""
    t, thrust = flight.vectors("rotor_state", lambda r: float(np.sum(r.thrust)))
    tc, commanded = flight.vectors(
        "motor_command", lambda c: vehicle.thrust_coefficient * float(np.sum(np.square(c.rotor_speed))) if c.armed else 0.0)
    for channel in ("rates_thrust_command", "attitude_thrust_command") if len(tc) == 0 else ():
        if flight.values(channel):
            tc, commanded = flight.vectors(channel, lambda c: vehicle.mass * c.thrust if c.armed else 0.0)
    if not thrust.any() or len(tc) == 0:  # autopilots report rotors only while they stand
        return np.empty(0), np.empty(0), np.empty(0)
    return t, thrust, np.interp(t, tc, commanded)


def rates(flight: Flight) -> dict[str, float]:
    """Messages per second of simulation time on each topic."""
    out = {}
    for topic in flight.topics:
        times = [t for t, _ in flight.values(topic)]
        if len(times) > 1 and times[-1] > times[0]:
            out[topic] = (len(times) - 1) / (times[-1] - times[0])
    return out


def diagnostics(flight: Flight) -> dict[str, list[dict[str, float]]]:
    """Return the numeric values, by name, of all diagnostics of each node, in order."""
    out: dict[str, list[dict[str, float]]] = {}
    for _, message in flight.values("diagnostics"):
        values = {}
        for key, value in message.values.items():
            with suppress(ValueError):
                values[key] = float(value)
        out.setdefault(str(message.values.get("node", "")).strip("/"), []).append(values)
    return out


def node_durations(flight: Flight) -> dict[str, dict[str, float]]:
    """Return the durations that the nodes report in `_ms` and `_us`, over the whole flight [ms].

    A node reports about once per second: each figure is the median of its reports, so that the first second, in which
    compiled functions are loaded, does not dominate.
    """
    out: dict[str, dict[str, float]] = {}
    for node, reports in diagnostics(flight).items():
        series: dict[str, list[float]] = {}
        for values in reports:
            for key, value in values.items():
                unit = DURATION.search(key)
                if unit is not None:
                    series.setdefault(DURATION.sub("_ms", key), []).append(value * (1e-3 if unit[1] == "us" else 1.0))
        if series:
            out[node] = {key: float(np.median(v)) for key, v in series.items()}
    return out


def missed_deadlines(flight: Flight) -> dict[str, dict[str, float]]:
    """Return number of deadlines, missed deadlines and their share [%] of each node in real time; empty in lockstep."""
    out: dict[str, dict[str, float]] = {}
    for node, reports in diagnostics(flight).items():
        counts = [values for values in reports if values.get("deadlines", 0.0) > 0.0]
        if counts:
            had, missed = counts[-1]["deadlines"], counts[-1]["missed_deadlines"]
            out[node] = {"deadlines": had, "missed": missed, "missed_percent": 100.0 * missed / had}
    return out


def tilt_degrees(q: np.ndarray) -> np.ndarray:
    """Angle of b3 from the vertical, (..., 4) -> (...) [deg]."""
    b3 = so3.quat_rotate(q, np.array([0.0, 0.0, 1.0]))
    return np.degrees(np.arccos(np.clip(b3[..., 2], -1.0, 1.0)))
