"""Scripted inspection in process, with error models of VIO and of the map of the cables. [P:VI-A]

The controller receives the estimated state and a map with errors; the true state is used by the sensors' models only.
"""

from __future__ import annotations

import numpy as np

from perch_control.modes import State
from perch_control.nmpc.controller import LINE_RAMP
from perch_core.errors import PerchError
from perch_core.trajectory import rest_to_rest
from perch_eval.inspection.measures import Inspected, reference_of, recorded
from perch_eval.scripted_flight import LEAD, TAKE_OFF_SPEED, ScriptedFlight
from perch_sim.scenario import Scenario

SETTLE = 1.0  # hover before the line terms begin, and when they have grown [s]


def fly(scenario: Scenario, seed: int, with_lines: bool = True) -> Inspected:
    """Take off to the first waypoint, wait until the line terms have full weight, and fly the waypoint lines.

    Args:
        scenario: scenario of mode `inspection`.
        seed: seed of all random draws.
        with_lines: whether the controller receives the lines; without them it follows the reference only.

    Raises:
        PerchError: the scenario is not an inspection, or the vehicle does not take off.
    """
    if scenario.mode != "inspection":
        raise PerchError(f"scenario {scenario.name}: mode {scenario.mode!r} is not inspection")
    flight = ScriptedFlight(scenario, seed)
    loop, mission, first = flight.loop, flight.mission, scenario.inspection.waypoints[0]
    loop.filters["controller", "powerlines"] = lambda now, lines: None
    flight.run(flight.arm() + 0.2)
    yaw, duration = float(np.radians(first.yaw_deg)), max(2.0, first.position[2] / TAKE_OFF_SPEED)
    mission.follow(rest_to_rest(mission.p_WB, np.array(first.position), yaw, yaw, duration, flight.time + LEAD))
    flight.run(flight.time + duration + LEAD + SETTLE)
    if mission.state is not State.HOVERING:
        raise PerchError(f"did not take off: {mission.message}")
    if with_lines:
        del loop.filters["controller", "powerlines"]
    flight.run(flight.time + LINE_RAMP + SETTLE)
    reference = reference_of(scenario, flight.time + LEAD)
    mission.follow(reference)
    flight.run(flight.time + LEAD + reference.duration)
    flying = mission.state in (State.TRACKING, State.HOVERING)
    found = recorded(loop.trace.flight, scenario, "" if flying else mission.message)
    assert found is not None
    return found
