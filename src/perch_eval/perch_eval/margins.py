"""Margins of a flight to failure: figures with the limits that they must keep."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from perch_core.vehicle import Vehicle
from perch_eval.flight import Flight
from perch_eval.metrics import contact_of, perch_window, thrust_history
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario


def margin(name: str, value: float, low: float, high: float, unit: str) -> dict[str, Any]:
    """Return a figure of a flight and its limits, infinite if there is none, in a unit, for `report.json`.

    `left` is the distance to the nearer limit; negative if it is violated.
    """
    return {"name": name, "value": value, "low": low, "high": high, "unit": unit, "left": min(value - low, high - value)}


def number(value: float, sign: str = "") -> str:
    """A value with three significant digits; with a `sign` of "+", a plus sign as well."""
    return f"{float(f'{value:.3g}'):{sign}g}"


def limits(margin: dict[str, Any]) -> str:
    """Return the limits of a margin in words, without the unit; None, as read from JSON, is no limit."""
    low, high = (None if limit is None or math.isinf(limit) else number(limit) for limit in (margin["low"], margin["high"]))
    return f"at least {low}" if high is None else f"at most {high}" if low is None else f"{low} to {high}"


def margin_text(margin: dict[str, Any]) -> str:
    """A margin as text: `0.7 m/s (0.2 to 1 m/s): +0.3 m/s left`."""
    unit = margin["unit"]
    return f"{number(margin['value'])} {unit} ({limits(margin)} {unit}): {number(margin['left'], '+')} {unit} left"


def margins(flight: Flight, vehicle: Vehicle, scenario: Scenario | None = None) -> list[dict[str, Any]]:
    """Return the margins of a perch, from the truth.

    Args:
        flight: the recording.
        vehicle: its thrust limits, and the body rate limit of plans.
        scenario: its limits of adhesion or gripper; None: no margins at contact.
    """
    return [*_in_flight(flight, vehicle), *(_at_contact(flight, scenario) if scenario is not None else ())]


def _in_flight(flight: Flight, vehicle: Vehicle) -> list[dict[str, Any]]:
    window, truth = perch_window(flight), flight.states("ground_truth/odometry")
    if window is None or truth is None:
        return []
    found = []
    t, thrust, _ = thrust_history(flight, vehicle)
    inside = (t >= window[0]) & (t < window[1])
    if inside.any():
        low, high = 4 * vehicle.thrust_min, 4 * vehicle.thrust_max
        found = [margin("greatest collective thrust", float(thrust[inside].max()), -math.inf, high, "N"),
                 margin("least collective thrust", float(thrust[inside].min()), low, math.inf, "N")]
    rates = np.linalg.norm(truth.w[(truth.t >= window[0]) & (truth.t < window[1])], axis=1)
    if len(rates):
        greatest, limit = math.degrees(float(rates.max())), math.degrees(vehicle.body_rate_max)
        found.append(margin("greatest body rate (limit of the plan)", greatest, -math.inf, limit, "deg/s"))
    return found


def _at_contact(flight: Flight, scenario: Scenario) -> list[dict[str, Any]]:
    touch = contact_of(flight)
    if touch is None or touch[1].state not in (ContactState.ATTACHED, ContactState.BOUNCED):
        return []
    contact, tilt = touch[1], math.degrees(touch[1].tilt_error)
    if scenario.mode == "powerline":
        grip = scenario.grip
        speed = math.hypot(contact.normal_speed, contact.tangential_speed)
        return [margin("distance of the cable at contact", contact.offset, -math.inf, grip.position, "m"),
                margin("tilt error at contact", tilt, -math.inf, grip.tilt_deg, "deg"),
                margin("speed at contact", speed, -math.inf, grip.speed, "m/s")]
    adhesion = scenario.adhesion
    return [margin("normal speed at contact", contact.normal_speed, *adhesion.normal_speed, "m/s"),
            margin("tangential speed at contact", contact.tangential_speed, -math.inf, adhesion.tangential_speed_max, "m/s"),
            margin("tilt error at contact", tilt, -math.inf, adhesion.tilt_error_max_deg, "deg")]
