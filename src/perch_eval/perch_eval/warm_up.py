"""Compile the numerics that every flight needs; they are compiled at first use and cached beside their sources.

    python -m perch_eval.warm_up flight     builds all control laws and flies a scenario without ROS, which needs no built workspace
    python -m perch_eval.warm_up nodes      runs the nodes of the scenario on the ground, in one process, for some simulated time

Compiling a kernel in flight blocks its node for so long that the vehicle may drop the node from the lockstep.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import closing
from pathlib import Path

from perch_control.assembly import build_law
from perch_control.laws import LAWS
from perch_control.parameters import ControllerParameters
from perch_core.vehicle import load_vehicle
from perch_eval.goal import SUCCESSES
from perch_eval.in_process import Sensing, fly
from perch_sim.scenario import load_scenario

SCENARIO = "surface_90"
SIMULATED = 1.5   # [s] long enough for VIO to start and the filter to take its poses
CLOCK_BEGINS = 1.0  # [s] the vehicle's
PATIENCE = 600.0  # [s] wall clock


def flight() -> bool:
    """Build the control laws and fly; return whether the flight succeeded."""
    scenario = load_scenario(SCENARIO)
    for law in LAWS:
        build_law(law, load_vehicle(scenario.vehicle), ControllerParameters(vehicle=scenario.vehicle))
    return fly(scenario, 1, Sensing(vio="rendered", target="rendered")).outcome in SUCCESSES


def nodes() -> bool:
    """Run the nodes; return whether simulation time advanced as far as intended.

    Raises:
        PerchError: a node ended, or did not come up.
    """
    from perch_eval.domain import own_domain
    from perch_eval.nodes import ALL_NODES, programs
    from perch_eval.ros.mission_client import MissionClient
    from perch_eval.stack import Stack

    scenario = load_scenario(SCENARIO)
    with tempfile.TemporaryDirectory() as name, own_domain():
        folder = Path(name)
        overrides = {"vehicle": {"lockstep_timeout": PATIENCE}}
        started = programs(scenario, composed=ALL_NODES, record=folder / "flight.mcap", folder=folder, overrides=overrides)
        with Stack(started, folder) as stack, closing(MissionClient()) as client:
            stack.wait_until_ready(client.visible_nodes, PATIENCE)
            client.linger(CLOCK_BEGINS + SIMULATED, stack.raise_if_ended, PATIENCE)
            return client.time >= CLOCK_BEGINS + SIMULATED


if __name__ == "__main__":
    sys.exit(0 if {"flight": flight, "nodes": nodes}[sys.argv[1]]() else 1)
