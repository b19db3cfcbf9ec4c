"""Moves the running script into perch's environment."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NoReturn

from .environment import variables
from .errors import FAILED, SetupError
from .layout import VENV, VENV_PYTHON
from .prepare import prepare

_ENTERED = "PERCH_ENTERED"
"""Variable with the id of the process restarted in the environment. An `exec` keeps the id; children have others."""
INTERRUPTED = 130
_HELP = {"-h", "--help"}


def command_parser(description: str, examples: str, **options) -> argparse.ArgumentParser:
    """Return a parser whose help shows description and examples verbatim; `options` are those of `ArgumentParser`."""
    return argparse.ArgumentParser(description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter, **options)


def enter(*extras: str) -> None:
    """Set up if necessary, then start this script again with our Python and variables.

    Args:
        extras: packages that this script needs in addition to those of a flight; not installed for its `--help`.

    Returns only inside the environment. Prints one line and exits if set-up fails.
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
    exec_program(str(VENV_PYTHON), [str(VENV_PYTHON), *sys.argv], environment)


@contextmanager
def setting_up() -> Iterator[None]:
    """End the script with one line if set-up in this context fails or is interrupted."""
    try:
        yield
    except SetupError as error:
        print(f"perch: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except (OSError, subprocess.CalledProcessError) as error:  # a full disk, files of another user, a numpy that cannot be loaded
        print(f"perch: set-up failed: {error}", file=sys.stderr)
        sys.exit(FAILED)
    except KeyboardInterrupt:
        print("\nperch set-up: interrupted; the next start goes on from here", file=sys.stderr)
        sys.exit(INTERRUPTED)


def exec_program(path: str, arguments: list[str], environment: Mapping[str, str] = os.environ) -> NoReturn:
    """Replace this process by another program. Ctrl-C is blocked until our code runs, as Python would show a traceback."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.execve(path, arguments, environment)


def run(module: str, *extras: str) -> NoReturn:
    """Set up if necessary, with extras, then run a module's `main` on this command line and exit with its code."""
    enter(*extras)
    with quiet_on_interrupt():
        main = importlib.import_module(module).main
    sys.exit(main())


def leave_quietly_on_interrupt() -> Any:
    """Let Ctrl-C end a script without a traceback, also outside our own code; return what handled it before."""
    return signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))


@contextmanager
def quiet_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the script without a traceback in this context; for imports, which take seconds."""
    before = leave_quietly_on_interrupt()
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before or signal.SIG_DFL)
