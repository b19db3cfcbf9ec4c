#!/usr/bin/env python3
"""List actions and send goals, with the arguments of `ros2 action`. Ctrl-C cancels the goal."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import Commands, carry_out

EXAMPLES = """examples:
  python3 scripts/action.py list -t
  python3 scripts/action.py send_goal /perch perch_msgs/action/Perch '{takeoff_height: 1.2, search_timeout: .nan, inclination_hint: .nan}' --feedback
"""


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    commands = Commands(__doc__, EXAMPLES)
    commands.add_list("actions")
    goal = commands.add("send_goal", "calls:send_goal", "send a goal and wait for its result")
    goal.add_argument("action")
    goal.add_argument("type", help="as in perch_msgs/action/Perch")
    goal.add_argument("values", help="fields of the goal in YAML")
    goal.add_argument("-f", "--feedback", action="store_true", help="print feedback as it comes")
    return commands.parser


if __name__ == "__main__":
    sys.exit(carry_out(command_line()))
