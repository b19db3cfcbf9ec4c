#!/usr/bin/env python3
"""Read and set parameters of running nodes, with the arguments of `ros2 param`."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import add_spin_time, main, parser

EXAMPLES = """examples:
  python3 scripts/param.py list /controller
  python3 scripts/param.py describe /controller
  python3 scripts/param.py get /controller gains.position
  python3 scripts/param.py set /controller gains.position '[8.0, 8.0, 10.0]'
  python3 scripts/param.py dump /controller > controller.yaml
"""
HANDLERS = {
    "list": "parameters:list_parameters",
    "get": "parameters:get_parameter",
    "set": "parameters:set_parameter",
    "describe": "parameters:describe_parameters",
    "dump": "parameters:dump_parameters",
}


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    top = parser(__doc__ or "", EXAMPLES)
    commands = top.add_subparsers(dest="command", required=True, metavar="|".join(HANDLERS))
    commands.add_parser("list", help="names, of one node or of all").add_argument("node", nargs="?")
    for name, text in (("get", "one value"), ("set", "change one value"), ("dump", "all values as a parameter file")):
        command = commands.add_parser(name, help=text)
        command.add_argument("node")
        if name != "dump":
            command.add_argument("parameter")
    description = commands.add_parser("describe", help="unit, range and meaning, of one parameter or of all")
    description.add_argument("node")
    description.add_argument("parameter", nargs="?")
    commands.choices["set"].add_argument("value", help="in YAML")
    for command in commands.choices.values():
        add_spin_time(command)
    return top


if __name__ == "__main__":
    sys.exit(main(command_line(), HANDLERS))
