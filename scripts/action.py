#!/usr/bin/env python3
"""List actions and send goals, with the arguments of `ros2 action`. Ctrl-C cancels the goal."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import add_spin_time, main, parser

EXAMPLES = """examples:
  python3 scripts/action.py list -t
  python3 scripts/action.py send_goal /perch perch_msgs/action/Perch '{takeoff_height: 1.2}' --feedback
"""
HANDLERS = {"list": "calls:list_actions", "send_goal": "calls:send_goal"}


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    top = parser(__doc__ or "", EXAMPLES)
    commands = top.add_subparsers(dest="command", required=True, metavar="|".join(HANDLERS))
    commands.add_parser("list", help="the actions of the graph").add_argument("-t", "--show-types", action="store_true")
    goal = commands.add_parser("send_goal", help="send a goal and wait for its result")
    goal.add_argument("action")
    goal.add_argument("type", help="as in perch_msgs/action/Perch")
    goal.add_argument("values", nargs="?", default="", help="fields of the goal in YAML")
    goal.add_argument("-f", "--feedback", action="store_true", help="print feedback as it comes")
    for command in commands.choices.values():
        add_spin_time(command)
    return top


if __name__ == "__main__":
    sys.exit(main(command_line(), HANDLERS))
