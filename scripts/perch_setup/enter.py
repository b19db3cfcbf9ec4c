"""Moves the running script into perch's environment."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NoReturn

from .environment import variables
from .errors import SetupError
from .layout import VENV, VENV_PYTHON
from .prepare import prepare

_ENTERED = "PERCH_ENTERED"
"""Process id of the script that was started again inside. An `exec` keeps the id; children have others."""
INTERRUPTED = 130
_HELP = {"-h", "--help"}


def command_parser(description: str, examples: str, **options) -> argparse.ArgumentParser:
    """A command line with examples below its help, which stay as they are written; `options` are those of `ArgumentParser`."""
    return argparse.ArgumentParser(description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter, **options)


def enter(*extras: str) -> None:
    """Set up if necessary, then start this script again with our Python and variables.

    Args:
        extras: packages that this script needs beside those of a flight; not for its `--help`.

    Returns only inside the environment. Prints one line and exits where set-up cannot be done.
    """
    if os.environ.get(_ENTERED) == str(os.getpid()) and sys.prefix == str(VENV):
        with quiet_on_interrupt():
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        return
    with setting_up():
        environment = variables(prepare(extras=() if _HELP & set(sys.argv) else extras))
    environment[_ENTERED] = str(os.getpid())
    sys.stdout.flush()
    sys.stderr.flush()
    become(str(VENV_PYTHON), [str(VENV_PYTHON), *sys.argv], environment)


@contextmanager
def setting_up() -> Iterator[None]:
    """A set-up that cannot be done, or is interrupted, ends the script with one line."""
    try:
        yield
    except SetupError as error:
        print(f"perch: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("\nperch set-up: interrupted; the next start goes on from here", file=sys.stderr)
        sys.exit(INTERRUPTED)


def become(path: str, arguments: list[str], environment: Mapping[str, str] = os.environ) -> NoReturn:
    """Start another program in this process. Python shows a traceback of Ctrl-C while it starts: one is held back until our code runs."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.execve(path, arguments, environment)


def run(module: str, *extras: str) -> NoReturn:
    """Set up if necessary, with extras, then be the program that a module's `main` is, with its options and its exit code."""
    enter(*extras)
    with quiet_on_interrupt():
        main = importlib.import_module(module).main
    sys.exit(main())


def leave_quietly_on_interrupt() -> None:
    """Let Ctrl-C end a script without a traceback, also where it is not waiting in our code."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))


@contextmanager
def quiet_on_interrupt() -> Iterator[None]:
    """Around imports, which take seconds: Ctrl-C ends the script without a traceback."""
    before = signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
