#!/usr/bin/env python3
"""List and call services, with the arguments of `ros2 service`."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import add_spin_time, main, parser

EXAMPLES = """examples:
  python3 scripts/service.py list -t
  python3 scripts/service.py call /plan_perch perch_msgs/srv/PlanPerch '{}'
"""
HANDLERS = {"list": "calls:list_services", "call": "calls:call_service"}


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    top = parser(__doc__ or "", EXAMPLES)
    commands = top.add_subparsers(dest="command", required=True, metavar="|".join(HANDLERS))
    listing = commands.add_parser("list", help="the services of the graph")
    listing.add_argument("-t", "--show-types", action="store_true")
    call = commands.add_parser("call", help="send a request, print the response")
    call.add_argument("service")
    call.add_argument("type", help="as in perch_msgs/srv/PlanPerch")
    call.add_argument("values", nargs="?", default="", help="fields of the request in YAML")
    for command in commands.choices.values():
        add_spin_time(command)
    return top


if __name__ == "__main__":
    sys.exit(main(command_line(), HANDLERS))
