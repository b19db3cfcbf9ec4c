"""Classification of flights: one cause of failure each, from the mission's result and the true contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence

from perch_core.values import Contact
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Adhesion, Grip, Scenario

SUCCESS, ERROR = "perched", "error"
MEANING = {
    "not_found": "the target was not found well enough in time", "refused": "the planner refused to plan",
    "lost_track": "control or estimation failed before the contact", "missed_pad": "touched beside the pad or nothing, or passed the cable",
    "too_fast": "arrived on the pad too fast, along or across it", "too_slow": "arrived on the pad too slowly to stick",
    "tilt": "arrived on the pad with too much tilt error", "came_off": "the mission reported success, but the velcro did not hold",
    "crash": "hit something hard, or with another part than the plate", "timeout": "did not come to an end in time",
    ERROR: "the flight could not be carried out",
}
_BY_OUTCOME = {"not_found": "not_found", "refused": "refused", "timeout": "timeout", "cancelled": "timeout",
               "bad_goal": "refused"}


def cause_of(outcome: str, contacts: Sequence[Contact], scenario: Scenario) -> str:
    """Return `perched`, or the cause of failure: a key of `MEANING`. A perch succeeds only if the vehicle is truly attached at
    the end; a completed inspection succeeds if there was no true collision.

    Args:
        outcome: outcome of the mission, in lower case.
        contacts: true contacts of the vehicle, in order.
        scenario: limits of the velcro and of the gripper.
    """
    if outcome == "perched":
        return SUCCESS if _attached_at_end(contacts) else "came_off"
    if outcome == "inspected" and not any(c.state == ContactState.COLLISION for c in contacts):
        return SUCCESS
    touches = [c for c in contacts if c.state in (ContactState.BOUNCED, ContactState.COLLISION)]
    if outcome in _BY_OUTCOME and not touches:
        return _BY_OUTCOME[outcome]
    if not touches:
        return "missed_pad" if outcome == "missed" else "lost_track"
    first = touches[0]
    if first.state == ContactState.COLLISION or first.body != "pad" and any("crashed" in c.reason for c in touches):
        return "crash"
    return _grip_cause(first, scenario.grip) if first.body.startswith("cable") else _bounce_cause(first, scenario.adhesion)


def _bounce_cause(touch: Contact, adhesion: Adhesion) -> str:
    """Return the limit of the velcro that a contact missed by the largest ratio."""
    if "outside the pad" in touch.reason:
        return "missed_pad"
    low, high = adhesion.normal_speed
    ratios = {"tilt": math.degrees(touch.tilt_error) / adhesion.tilt_error_max_deg,
              "too_fast": max(touch.normal_speed / high, touch.tangential_speed / adhesion.tangential_speed_max),
              "too_slow": low / max(touch.normal_speed, 1e-3)}
    return max(ratios, key=lambda name: ratios[name])


def _grip_cause(touch: Contact, grip: Grip) -> str:
    """Return the limit of the gripper that a pass of a cable missed by the largest ratio; one that is switched off misses the cable."""
    ratios = {"missed_pad": touch.offset / grip.position if grip.enabled else math.inf,
              "tilt": math.degrees(touch.tilt_error) / grip.tilt_deg,
              "too_fast": math.hypot(touch.normal_speed, touch.tangential_speed) / grip.speed}
    return max(ratios, key=lambda name: ratios[name])


def _attached_at_end(contacts: Sequence[Contact]) -> bool:
    holder = ""  # pad or cable
    for c in contacts:
        if c.state == ContactState.ATTACHED:
            holder = c.body
        elif c.body == holder:
            holder = ""
    return bool(holder)
