#!/usr/bin/env python3
"""Read and set parameters of running nodes, with the arguments of `ros2 param`."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import Commands, carry_out

EXAMPLES = """examples:
  python3 scripts/param.py list /controller
  python3 scripts/param.py describe /controller
  python3 scripts/param.py get /controller gains.position
  python3 scripts/param.py set /controller gains.position '[8.0, 8.0, 10.0]'
  python3 scripts/param.py dump /controller > controller.yaml
"""


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    commands = Commands(__doc__, EXAMPLES)
    commands.add("list", "parameters:list_parameters", "names, of one node or of all").add_argument("node", nargs="?")
    get = commands.add("get", "parameters:get_parameter", "one value")
    change = commands.add("set", "parameters:set_parameter", "change one value")
    describe = commands.add("describe", "parameters:describe_parameters", "unit, range and meaning, of some parameters or of all")
    for command, how_many in ((get, None), (change, None), (describe, "*")):
        command.add_argument("node")
        command.add_argument("parameter", nargs=how_many, help="as in gains.position")
    change.add_argument("value", help="in YAML")
    commands.add("dump", "parameters:dump_parameters", "all values as a parameter file").add_argument("node")
    return commands.parser


if __name__ == "__main__":
    sys.exit(carry_out(command_line()))
