#!/usr/bin/env python3
"""Start one node, as `ros2 run` does, on machines without the `ros2` command.

The node gets its parameter file config/<node>.yaml. Arguments after the node's name are passed on to the node,
after the file, so that they take precedence.
"""

from __future__ import annotations

import sys

from perch_setup import command_parser, enter, exec_program, quiet_on_interrupt

EXAMPLES = """examples:
  python3 scripts/run_node.py vehicle
  python3 scripts/run_node.py controller --ros-args -r __ns:=/quad1 -p controller.type:=nmpc
  python3 scripts/run_node.py betaflight --ros-args -p vehicle:=my_vehicle.yaml -p link:=/dev/ttyACM0@115200
  python3 scripts/run_node.py estimator --no-config --ros-args --params-file my.yaml
"""


def main() -> int:
    """Replace this process by the node; return 2 if node or network are refused."""
    parser = command_parser(__doc__, EXAMPLES, allow_abbrev=False)
    parser.add_argument("node", metavar="NODE", help="vehicle, controller, ... (README, The graph), betaflight or mavlink")
    parser.add_argument("--no-config", action="store_true", help="do not pass config/<node>.yaml")
    parser.add_argument("--network", metavar="ADDRESS", help="open the ROS graph to the network in which this machine has this address (SECURITY.md)")
    arguments, for_node = parser.parse_known_args()
    enter(*["view"] * (arguments.node == "viewer"))
    with quiet_on_interrupt():
        from perch_core.config import config_dir
        from perch_core.errors import PerchError
        from perch_eval.arguments import open_network
        from perch_eval.nodes import executable
        from perch_sim.scenario import NODES

    packages = NODES | dict.fromkeys(("betaflight", "mavlink"), "perch_autopilot")
    try:
        if arguments.node not in packages:
            raise PerchError(f"node {arguments.node!r} is not one of {', '.join(packages)}")
        open_network(arguments.network)
        path = executable(packages[arguments.node], arguments.node)
        file = config_dir() / f"{arguments.node}.yaml"
    except PerchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    with_file = ["--ros-args", "--params-file", str(file), "--"] if file.exists() and not arguments.no_config else []
    exec_program(path, [path, *with_file, *for_node])


if __name__ == "__main__":
    sys.exit(main())
