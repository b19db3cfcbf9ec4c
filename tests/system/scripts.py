"""Runs the repository's scripts as a user does, in processes of their own or, where a process shows nothing more, forked or in this one."""

from __future__ import annotations

import contextlib
import io
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path
from unittest import mock

from system import forks

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 600.0
"""Only ever waited for in full when a test fails [s]."""


def run_script(name: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Run `scripts/<name>` to its end."""
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / name), *arguments], env={**os.environ, **environment},
        capture_output=True, text=True, timeout=PATIENCE)


def fork_script(name: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Run `scripts/<name>` to its end in a process that is forked from one that has made its imports, for scripts that join the ROS graph."""
    return forks.run(forks.SCRIPTS, [str(ROOT / "scripts" / name), *arguments], PATIENCE, {**os.environ, **environment})


def call_script(name: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Run `scripts/<name>` to its end in this process, whose imports it finds made. Not for scripts that join the ROS graph."""
    path, out, error = str(ROOT / "scripts" / name), io.StringIO(), io.StringIO()
    entered = {"PERCH_ENTERED": str(os.getpid())}  # this process is in the environment that the script would enter
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with mock.patch.object(sys, "argv", [path, *arguments]), mock.patch.dict(os.environ, environment | entered), \
                contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            runpy.run_path(path, run_name="__main__")
            code: object = 0
    except SystemExit as end:
        code = end.code
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if isinstance(code, str):  # as the interpreter does
        error.write(f"{code}\n")
    return subprocess.CompletedProcess([path, *arguments], code if isinstance(code, int) else int(code is not None), out.getvalue(), error.getvalue())


def start_script(name: str, *arguments: str, **environment: str) -> subprocess.Popen:
    """Start `scripts/<name>`; its output can be read."""
    return subprocess.Popen(
        [sys.executable, "-u", str(ROOT / "scripts" / name), *arguments], env={**os.environ, **environment},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
