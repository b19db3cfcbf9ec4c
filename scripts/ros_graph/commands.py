"""The common command line of the graph scripts. Standard library only."""

from __future__ import annotations

import argparse
import importlib
import re
import sys

from perch_setup import command_parser, enter, quiet_on_interrupt
from perch_setup.enter import INTERRUPTED
from perch_setup.errors import FAILED, USAGE_ERROR

_ADVICE = "Is the stack ready? Wait until start_stack.py prints `ready`, then try again."


class GraphError(Exception):
    """Raised when the graph does not fit the request. The message is one line."""


class NoAnswerError(GraphError):
    """Raised when a part of the graph does not answer in time."""


def is_absolute_name(name: str) -> bool:
    """Return whether a name is an absolute one of ROS, as /quad1/odometry."""
    return re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name) is not None


class Commands:
    """The sub-commands of a script.

    Attributes:
        parser: of the command line.
    """

    def __init__(self, description: str | None, examples: str) -> None:
        self._examples = examples
        self.parser = command_parser(description or "", examples, allow_abbrev=False)
        self._verbs = self.parser.add_subparsers(required=True)

    def add(self, name: str, handler: str, about: str) -> argparse.ArgumentParser:
        """Add a sub-command and return its parser, for its arguments.

        Args:
            name: on the command line.
            handler: `module:function` in this package, imported inside the environment only; takes `GraphConnection` and arguments.
            about: its help text; examples in its own help are those of the script that call it.
        """
        own = "\n".join(line for line in self._examples.splitlines() if f".py {name} " in line)
        command = self._verbs.add_parser(name, help=about, description=about, epilog=f"examples:\n{own}",
                                         formatter_class=argparse.RawDescriptionHelpFormatter)
        command.set_defaults(handler=handler)
        command.add_argument("--spin-time", type=positive, default=5.0, metavar="S", help="wait at most this long for discovery [s] (default: %(default)g)")
        self._verbs.metavar = "|".join(self._verbs.choices)
        return command

    def add_list(self, kind: str) -> None:
        """Add the sub-command `list`, of `topics`, `services` or `actions`."""
        command = self.add("list", "connection:list_names", f"the {kind} of the graph")
        command.set_defaults(kind=kind)
        command.add_argument("-t", "--show-types", action="store_true", help="with their types")


def count(text: str) -> int:
    """Parse a number of messages, at least one."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not >= 1")
    return value


def positive(text: str) -> float:
    """Parse a positive, finite quantity."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a number > 0")
    return value


def carry_out(command_line: argparse.ArgumentParser) -> int:
    """Parse, set up if necessary, and run the sub-command; errors become one line, Ctrl-C and a closed pipe end it quietly.

    Returns:
        The exit code: that of the sub-command, 1 without an answer, or 2 for invalid input.
    """
    arguments = command_line.parse_args()
    enter()
    with quiet_on_interrupt():
        from perch_core.errors import PerchError  # as rclpy, inside the environment only
        from perch_core.processes import discard_closed_output
        from ros_graph.connection import connect

        module, function = arguments.handler.split(":")
        handler = getattr(importlib.import_module(f"ros_graph.{module}"), function)
    try:
        with connect() as graph:
            code = handler(graph, arguments)
        sys.stdout.flush()
        return code
    except NoAnswerError as error:
        print(f"error: {error}. {_ADVICE}", file=sys.stderr)
        return FAILED
    except (GraphError, PerchError) as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # `topic.py echo ... | head`
        discard_closed_output()
        return 0
