"""Python scripts in processes of their own that start in a tenth of a second: forked from one that has made their imports.

What a script is to its user, its imports and its command line included, is shown where `subprocess` starts it. Here it is run where
that is shown elsewhere: `runpy` runs the same file, in a process with its own signals, environment, exit code and place in the ROS graph.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest

SCRIPTS = ("rclpy", "rclpy.action", "perch_setup", "ros_graph.commands", "numpy", "yaml")
"""What the scripts at a graph import."""
NODES = ("perch_perception.vio_node", "perch_perception.target_localizer_node", "perch_perception.powerline_mapper_node",
         "perch_planner.powerline_planner_node", "perch_eval.recorder_node", "perch_eval.viewer_node", "perch_eval.graph_faults.preload")
"""What nodes import, and compile."""


class Forks:
    """A process that forks."""

    def __init__(self, modules: Sequence[str]) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen([sys.executable, str(Path(__file__).with_name("fork_server.py")), str(theirs.fileno()), *modules],
                                             pass_fds=[theirs.fileno()], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
        self._requests, self._lock = ours, threading.Lock()

    def start(self, command: Sequence[str], environment: Mapping[str, str], stdin: int, stdout: int, stderr: int) -> IO[str]:
        """Fork; its process id, and later its exit code, can be read."""
        reads, writes = os.pipe()
        message = json.dumps([list(command), dict(environment)]).encode()
        with self._lock:
            socket.send_fds(self._requests, [message], [stdin, stdout, stderr, writes])
        os.close(writes)
        return os.fdopen(reads)


@cache
def forks(modules: Sequence[str]) -> Forks:
    """One for each set of modules; it ends with this process, and with those that are forked from it and share it."""
    return Forks(modules)


class Forked:
    """A script's process, as `subprocess.Popen` has it; its standard input is empty.

    Attributes:
        args: script and arguments.
        pid: process id, which is that of its group, too.
        returncode: exit code, or minus the number of the signal that ended it; None while it works.
    """

    def __init__(self, modules: Sequence[str], args: Sequence[str], stdout: IO, stderr: IO, environment: Mapping[str, str] | None = None) -> None:
        """
        Args:
            modules: `SCRIPTS` or `NODES`.
            args: path of a Python script, and its arguments.
            stdout, stderr: receive what it writes.
            environment: all of it; by default this process's.
        """
        self.args, self.returncode = list(args), None
        with open(os.devnull) as nothing:
            self._answers = forks(modules).start(args, os.environ if environment is None else environment, nothing.fileno(), stdout.fileno(), stderr.fileno())
        self.pid = int(self._answers.readline())
        self._over = threading.Event()
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        with self._answers as answers:
            self.returncode = int(answers.readline() or -signal.SIGKILL)
        self._over.set()

    def poll(self) -> int | None:
        """As `Popen`'s."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """As `Popen`'s."""
        if not self._over.wait(timeout):
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: signal.Signals) -> None:
        """As `Popen`'s."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """As `Popen`'s."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """As `Popen`'s."""
        self.send_signal(signal.SIGKILL)


class Piped(Forked):
    """The same with its output in a pipe, `stdout`."""

    def __init__(self, modules: Sequence[str], args: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        """As `Forked`."""
        reads, writes = os.pipe()
        with os.fdopen(writes, "w") as output:
            super().__init__(modules, args, output, output, environment)
        self.stdout = os.fdopen(reads, errors="replace")


def popen(command: Sequence[str], *, env: Mapping[str, str], **_: object) -> Piped:
    """In the place of `subprocess.Popen` in `perch_eval.program`."""
    words = list(command)[command.index("--") + 1 if "--" in command else 0:]
    if words[1] == "-m":
        spec = importlib.util.find_spec(words[2])
        assert spec is not None and spec.origin is not None
        words[:3] = [spec.origin]
    return Piped(NODES, words, env)


def fork_programs(patch: pytest.MonkeyPatch, but: Collection[str] = ()) -> None:
    """Until the end of `patch`, the nodes of stacks are forked, but for the executables named.

    Where stacks start executables is shown in `test_scripts_stack.py`, `test_bad_input.py` and `test_flight_surface.py`.
    """
    def start(command: Sequence[str], **options: Any) -> Piped | subprocess.Popen:
        return subprocess.Popen(command, **options) if any(Path(word).name in but for word in command) else popen(command, **options)

    patch.setattr("perch_eval.program.subprocess", SimpleNamespace(**{**vars(subprocess), "Popen": start}))


def run(modules: Sequence[str], args: Sequence[str], timeout: float, environment: Mapping[str, str] | None = None) -> subprocess.CompletedProcess:
    """Run a script to its end, as `subprocess.run` does."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as error:
        one = Forked(modules, args, out, error, environment)
        try:
            code = one.wait(timeout)
        finally:
            one.kill()
        out.seek(0), error.seek(0)
        return subprocess.CompletedProcess(one.args, code, out.read(), error.read())
