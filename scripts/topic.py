#!/usr/bin/env python3
"""Inspect topics and publish, with the arguments of `ros2 topic`, on machines without the `ros2` command."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import Commands, carry_out, count, positive

EXAMPLES = """examples:
  python3 scripts/topic.py list -t
  python3 scripts/topic.py echo /odometry --field pose.pose.position
  python3 scripts/topic.py echo /camera_front/image_raw --once --no-arr
  python3 scripts/topic.py hz /imu/data_raw --window 500
  python3 scripts/topic.py info /trajectory -v
  python3 scripts/topic.py pub --once /controller/command perch_msgs/msg/ControllerCommand '{command: 2, reason: by hand}'
"""


def command_line() -> argparse.ArgumentParser:
    """Sub-commands and their arguments."""
    commands = Commands(__doc__, EXAMPLES)
    commands.add_list("topics")
    info = commands.add("info", "topics:show_info", "a topic's type, publishers and subscribers")
    info.add_argument("topic")
    info.add_argument("-v", "--verbose", action="store_true", help="nodes and QoS")

    echo = commands.add("echo", "topics:echo", "print messages as they come")
    _add_topic(echo)
    echo.add_argument("--once", action="store_true", help="end after one message")
    echo.add_argument("-n", type=count, metavar="N", help="end after N messages")
    echo.add_argument("--field", metavar="PATH", help="only a part, as in pose.pose.position.x or rotor_speed[0]")
    echo.add_argument("--no-arr", action="store_true", help="do not print arrays")

    rate = commands.add("hz", "topics:measure_rate", "measure the rate")
    _add_topic(rate)
    rate.add_argument("-w", "--window", type=count, default=10_000, metavar="N", help="messages to average over (default: %(default)s)")
    rate.add_argument("-n", type=count, metavar="N", help="end after N messages")

    publish = commands.add("pub", "topics:publish", "publish a message, repeatedly until Ctrl-C")
    publish.add_argument("topic")
    publish.add_argument("type", help="as in std_msgs/msg/Float64")
    publish.add_argument("values", nargs="?", default="", help="fields in YAML, as in '{data: 1.0}'")
    publish.add_argument("-r", "--rate", type=positive, default=1.0, metavar="HZ", help="messages per second (default: %(default)g)")
    publish.add_argument("-1", "--once", action="store_true", help="publish it once, when there is a subscriber")

    return commands.parser


def _add_topic(command: argparse.ArgumentParser) -> None:
    command.add_argument("topic")
    command.add_argument("type", nargs="?", help="its type (default: from the graph)")


if __name__ == "__main__":
    sys.exit(carry_out(command_line()))
