"""What the graph scripts share: the frame of their command line. Standard library only."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Mapping

from perch_setup import enter

CALLERS_MISTAKE = 2
INTERRUPTED = 130


class GraphError(Exception):
    """Something in the graph is not as the caller thinks. The message is one line."""


def parser(description: str, examples: str) -> argparse.ArgumentParser:
    """A command line with examples below its help."""
    return argparse.ArgumentParser(
        description=description,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


def count(text: str) -> int:
    """A number of messages on a command line: at least one."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not >= 1")
    return value


def positive(text: str) -> float:
    """A quantity on a command line that is neither zero, negative nor infinite."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a number > 0")
    return value


def add_spin_time(target: argparse.ArgumentParser) -> None:
    """How long to wait for the graph to become known."""
    target.add_argument(
        "--spin-time", type=float, default=3.0, metavar="S", help="wait at most so long for discovery [s] (default: 3)"
    )


def main(command_line: argparse.ArgumentParser, handlers: Mapping[str, str]) -> int:
    """Parse, set up if necessary, and run one sub-command.

    Args:
        command_line: with sub-commands that set `command`.
        handlers: sub-command -> `module:function` in this package; imported only inside the environment.
    """
    arguments = command_line.parse_args()
    enter()
    module, function = handlers[arguments.command].split(":")
    return run(lambda: getattr(importlib.import_module(f"ros_graph.{module}"), function)(arguments))


def run(command: Callable[[], int]) -> int:
    """Run a command; errors become one line, Ctrl-C and a closed pipe end it quietly.

    Returns:
        The exit code: that of the command, or 2 for the caller's mistakes.
    """
    from perch_core.errors import PerchError  # there is one inside the environment only

    try:
        code = command()
        sys.stdout.flush()
        return code
    except (GraphError, PerchError) as error:
        print(f"error: {error}", file=sys.stderr)
        return CALLERS_MISTAKE
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # `topic.py echo ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
