"""Compile once what every flight needs: the numerics are compiled at first use and cached beside their sources.

    python -m perch_eval.warm_up

All nodes of a scenario are run in one process on the ground for a moment of simulated time; then its flight is flown in process.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path

from perch_core.ros.node import close_nodes  # before numpy: it limits numpy's threads

import rclpy
from perch_core.ros import qos
from perch_core.scenario import load_scenario
from perch_eval.composed_node import create_nodes
from perch_eval.domain import reserved_domain
from perch_eval.in_process import Sensing, fly
from perch_eval.nodes import ALL_NODES, programs
from perch_eval.pilot import SUCCESSES
from perch_msgs.msg import Step
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

SIMULATED = 1.5   # [s] long enough for VIO to start and the filter to take its poses
PATIENCE = 600.0  # [s] wall clock


def warm_up(scenario_name: str = "surface_90") -> bool:
    """Run a scenario's nodes on the ground, then its flight in process; whether both got as far as they should.

    A kernel that is left to be compiled in flight keeps its node silent for so long that the vehicle may drop it.
    """
    scenario = load_scenario(scenario_name)
    with tempfile.TemporaryDirectory() as folder, reserved_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        programs(scenario, composed=ALL_NODES, record=Path(folder) / "flight.mcap", folder=Path(folder))
        plan = json.loads((Path(folder) / "composed.json").read_text())
        rclpy.init(args=[])
        nodes = create_nodes(plan)
        watch = Node("warm_up")
        reached = [0.0]
        watch.create_subscription(
            Step, "step", lambda m: reached.__setitem__(0, m.stamp.sec + 1e-9 * m.stamp.nanosec), qos.STEP)
        executor = EventsExecutor()
        for node in (*nodes, watch):
            executor.add_node(node)
        # The vehicle's clock starts at one second.
        end, last = 1.0 + SIMULATED, time.monotonic() + PATIENCE
        while reached[0] < end and time.monotonic() < last:
            executor.spin_once(timeout_sec=0.5)
        close_nodes([*nodes, watch])
        rclpy.try_shutdown()
    return reached[0] >= end and fly(scenario, 1, Sensing(vio="rendered", target="rendered")).outcome in SUCCESSES


if __name__ == "__main__":
    sys.exit(0 if warm_up() else 1)
