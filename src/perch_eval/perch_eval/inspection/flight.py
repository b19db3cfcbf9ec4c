"""One inspection in process, led by a script: VIO and the map of the cables by their error models. [P:VI-A]

The controller knows the state that the estimator has and a map with an error; truth enters through the sensors' models alone.
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
    """Take off below the first waypoint, let the line terms grow, fly the waypoint lines.

    Args:
        scenario: mode `inspection`.
        seed: of everything that is random.
        with_lines: False: the controller is not told of the lines, and follows the reference as it is.

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
