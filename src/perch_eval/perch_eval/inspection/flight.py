"""One inspection in process, led by a script: VIO and the map of the cables by their error models. [P:VI-A]

The controller knows the state that the estimator has and a map with an error; truth enters through the sensors' models alone.
"""

from __future__ import annotations

import numpy as np

from perch_control.mission.parameters import MissionParameters
from perch_control.modes import Command, State
from perch_core.errors import PerchError
from perch_core.trajectory import rest_to_rest
from perch_eval.control_flights.pilot import LEAD, TAKE_OFF_SPEED, ScriptedPilot
from perch_eval.in_process import Loop, arrange
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.inspection.measures import Inspected, reference_of
from perch_eval.inspection.recorded import recorded
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
    pilot = ScriptedPilot(NodeParameters(scenario, seed).of("mission", MissionParameters))
    loop = arrange(scenario, seed, pilot=pilot)
    loop.filters["controller", "powerlines"] = lambda now, lines: None
    _take_off(loop, pilot, scenario)
    if with_lines:
        del loop.filters["controller", "powerlines"]
    _run(loop, loop.components["controller"].config.nmpc.lines.ramp_time + SETTLE)
    reference = reference_of(scenario, loop.time + LEAD)
    pilot.follow(reference)
    _run(loop, LEAD + reference.duration)
    flying = pilot.state in (State.TRACKING, State.HOVERING)
    return recorded(loop.trace.flight, scenario, "" if flying else pilot.message)


def _run(loop: Loop, duration: float) -> None:
    """Fly on, or until the vehicle breaks."""
    end = loop.time + duration
    while loop.time < end and not loop.vehicle.simulation.plant.crashed:
        loop.step()


def _take_off(loop: Loop, pilot: ScriptedPilot, scenario: Scenario) -> None:
    first = scenario.inspection.waypoints[0]
    while not pilot.ready:
        if loop.time > 10.0:
            raise PerchError(f"the estimator is not ready: {pilot.estimator.message}")
        loop.step()
    _run(loop, 0.2)
    pilot.order(Command.ARM, "inspection")
    _run(loop, 0.2)
    yaw = float(np.radians(first.yaw_deg))
    duration = max(2.0, first.position[2] / TAKE_OFF_SPEED)
    pilot.follow(rest_to_rest(pilot.p_WB, np.array(first.position), yaw, yaw, duration, loop.time + LEAD))
    _run(loop, duration + LEAD + SETTLE)
    if pilot.state is not State.HOVERING:
        raise PerchError(f"did not take off: {pilot.message}")
