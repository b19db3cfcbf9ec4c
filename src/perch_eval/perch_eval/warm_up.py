"""Compile once what every flight needs: the numerics are compiled at first use and cached beside their sources.

    python -m perch_eval.warm_up

All nodes of a scenario are run in one process on the ground for a moment of simulated time; then its flight is flown in process.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from perch_eval.domain import reserved_domain
from perch_eval.goal import SUCCESSES
from perch_eval.in_process import Sensing, fly
from perch_eval.nodes import ALL_NODES, programs
from perch_eval.ros.mission_client import MissionClient
from perch_eval.stack import Stack
from perch_sim.scenario import load_scenario

SIMULATED = 1.5   # [s] long enough for VIO to start and the filter to take its poses
CLOCK_BEGINS = 1.0  # [s] the vehicle's
PATIENCE = 600.0  # [s] wall clock


def warm_up() -> bool:
    """Run a scenario's nodes on the ground, then its flight in process; whether both got as far as they should.

    A kernel that is left to be compiled in flight keeps its node silent for so long that the vehicle may drop it.

    Raises:
        PerchError: a node ended, or did not come up.
    """
    scenario = load_scenario("surface_90")
    with tempfile.TemporaryDirectory() as name, reserved_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        folder = Path(name)
        overrides = {"vehicle": {"lockstep_timeout": PATIENCE}}
        started = programs(scenario, composed=ALL_NODES, record=folder / "flight.mcap", folder=folder, overrides=overrides)
        with Stack(started, folder) as stack:
            client = MissionClient()
            try:
                stack.wait_until_ready(client.visible_nodes, PATIENCE)
                client.linger(CLOCK_BEGINS + SIMULATED, stack.raise_if_ended, PATIENCE)
                reached = client.time >= CLOCK_BEGINS + SIMULATED
            finally:
                client.close()
    return reached and fly(scenario, 1, Sensing(vio="rendered", target="rendered")).outcome in SUCCESSES


if __name__ == "__main__":
    sys.exit(0 if warm_up() else 1)
