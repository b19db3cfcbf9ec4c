"""Scripted inspection in process, with error models of VIO and of the map of the cables. [P:VI-A]

The controller receives the estimated state and a map with errors; the true state is used by the sensors' models only. The line
terms avoid cables of the map only, and those beside the vehicle are out of the front camera's view: as [P:VI] maps the lines before
it flies past them, the vehicle looks along the waypoints first.
"""

from __future__ import annotations

from math import atan2, radians

import numpy as np

from perch_control.mission.moves import Moves
from perch_control.modes import State
from perch_control.nmpc.controller import LINE_RAMP
from perch_core.errors import PerchError
from perch_eval.inspection.measures import InspectionResult, recorded_inspection, reference_of
from perch_eval.scripted_flight import LEAD, ScriptedFlight
from perch_sim.scenario import Scenario

SETTLE = 1.0  # hover before the line terms begin, and when they have grown [s]


def heading_along(scenario: Scenario) -> float:
    """Return the yaw [rad] that looks from the first waypoint to the last one."""
    first, last = (scenario.inspection.waypoints[k].position for k in (0, -1))
    return atan2(last[1] - first[1], last[0] - first[0])


def fly(scenario: Scenario, seed: int, with_lines: bool = True) -> InspectionResult:
    """Take off to the first waypoint, look along the waypoints, wait until the line terms have full weight, and fly the waypoint lines.

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
    loop, mission, moves = flight.loop, flight.mission, Moves(flight.mission.config.mission)
    first = scenario.inspection.waypoints[0]
    loop.filters["controller", "powerlines"] = lambda now, lines: None
    flight.run(flight.arm() + 0.2)
    moves.hover = mission.p_WB, radians(scenario.start.yaw_deg)
    for yaw in (heading_along(scenario), radians(first.yaw_deg)):
        mission.follow(moves.go(flight.time, (np.array(first.position), yaw)))
        flight.run(flight.time + moves.length + SETTLE)
    if mission.state is not State.HOVERING:
        raise PerchError(f"did not take off: {mission.message}")
    if with_lines:
        del loop.filters["controller", "powerlines"]
    flight.run(flight.time + LINE_RAMP + SETTLE)
    reference = reference_of(scenario, flight.time + LEAD)
    mission.follow(reference)
    flight.run(flight.time + LEAD + reference.duration)
    flying = mission.state in (State.TRACKING, State.HOVERING)
    found = recorded_inspection(loop.trace.flight, scenario, "" if flying else mission.message)
    assert found is not None
    return found
