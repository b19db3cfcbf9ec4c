#!/usr/bin/env python3
"""List and call services, with the arguments of `ros2 service`."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import Commands, carry_out

EXAMPLES = """examples:
  python3 scripts/service.py list -t
  python3 scripts/service.py call /abort std_srvs/srv/Trigger
"""


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    commands = Commands(__doc__, EXAMPLES)
    commands.add_list("services")
    call = commands.add("call", "calls:call_service", "send a request, print the response")
    call.add_argument("service")
    call.add_argument("type", help="as in perch_msgs/srv/PlanPerch")
    call.add_argument("values", nargs="?", default="", help="fields of the request in YAML")
    return commands.parser


if __name__ == "__main__":
    sys.exit(carry_out(command_line()))
