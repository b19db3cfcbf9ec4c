"""Comparison of the controllers on the same flights: geometric and NMPC, each with and without L1, nominal and disturbed."""

from __future__ import annotations

import numpy as np

from perch_eval.ending import simulated_ending
from perch_eval.scripted_flight import LEAD, TAKE_OFF_SPEED, ScriptedFlight, scenario_of

SCENARIO = "surface_90"
CONTROLLERS = {"geometric": ("geometric", False), "geometric + L1": ("geometric", True),
               "nmpc": ("nmpc", False), "nmpc + L1": ("nmpc", True)}
"""Name -> (`controller.type`, `controller.adaptive`)."""

CONDITIONS: dict[str, dict] = {
    "nominal": {},
    "wind 5 m/s": {"wind": {"steady": [3.5, 3.5, 0.0]}},
    "gusts, sigma 1.5 m/s": {"wind": {"gust_sigma": 1.5}},
    "mass +20 %": {"disturbance": {"mass_factor": 1.2}},
    "wind 5 m/s, mass +20 %": {"wind": {"steady": [3.5, 3.5, 0.0]}, "disturbance": {"mass_factor": 1.2}},
    "one rotor -15 %": {"disturbance": {"rotor_thrust_factor": [0.85, 1.0, 1.0, 1.0]}},
    "inertia +30 %": {"disturbance": {"inertia_factor": 1.3}},
    "motor lag doubled": {"disturbance": {"motor_lag_factor": 2.0}},
    "ground and wall effect": {"disturbance": {"surface_effect": True}},
}
MANEUVERS = ("line", "perch")
SETTLE, HOVER = 1.5, 0.5
LINE, LINE_TIME = np.array([0.7, 1.0, 0.4]), 2.0  # [m], [s]


def fly(controller: str, condition: str, maneuver: str, seed: int) -> tuple[np.ndarray, str]:
    """Take off, hover until the adaptation has settled, then fly a line and hover, or perch on the wall; the state is estimated.

    Returns:
        RMSE of the true position against the reference per axis [m], shape (3,), nan if the manoeuvre did not begin; and the
        outcome: held, perched, or the failure.
    """
    law, adaptive = CONTROLLERS[controller]
    flight = ScriptedFlight(scenario_of(SCENARIO, CONDITIONS[condition], {"controller.type": law, "controller.adaptive": adaptive}), seed)
    flight.arm()
    flight.run(flight.time + 0.2)
    mission, height = flight.mission, flight.scenario.mission.takeoff_height
    place = mission.p_WB + (0.0, 0.0, height)
    mission.move(np.array([0.0, 0.0, height]), height / TAKE_OFF_SPEED)
    flight.run(flight.time + LEAD + height / TAKE_OFF_SPEED + SETTLE)
    begin = flight.time
    order: int | None
    if maneuver == "line":
        order = mission.move(LINE, LINE_TIME)
        end = begin + LEAD + LINE_TIME
        flight.run(end + HOVER)
    else:
        order = flight.perch(place)
        end = mission.contact_due
        flight.run(min(end, flight.time + 10.0) + 1.0)
    if not flight.accepted(order):
        return np.full(3, np.nan), f"not begun: {flight.events[-1][2]}"
    flown = flight.loop.trace.flight
    # A vehicle that has touched the wall follows no reference.
    touched = min([t for t, c in flown.values("contact") if t > begin], default=np.inf)
    reference = flown.reference()
    assert reference is not None
    during = (reference.t >= begin) & (reference.t <= min(end if maneuver == "perch" else np.inf, touched))
    times, p = reference.t[during], reference.p[during]
    return np.sqrt(np.mean((p - flown.known_states("ground_truth/odometry").at(times).p) ** 2, axis=0)), _outcome(flight, maneuver)


def _outcome(flight: ScriptedFlight, maneuver: str) -> str:
    end = simulated_ending(flight.simulation, flight.state)
    if end == "crashed":
        return end
    if maneuver == "perch":
        if end in ("perched", "held with running motors"):
            return end
        refused = next((c.reason for c in flight.loop.trace.contacts if c.body == "pad" and c.reason), "")
        return f"missed: {refused}" if refused else f"missed, {flight.state.name.lower()}"
    return "held" if flight.state.name == "HOVERING" else flight.state.name.lower()
