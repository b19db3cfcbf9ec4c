"""One program of a stack: its process group, its output, and how it ended."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

_TAIL = 12


@dataclass(frozen=True)
class Program:
    """A program to start.

    Attributes:
        name: for logs and messages.
        command: executable and arguments.
        nodes: fully qualified names of the ROS nodes that it brings into the graph.
    """

    name: str
    command: tuple[str, ...]
    nodes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ending:
    """How a program ended.

    Attributes:
        name: the program's name.
        code: exit code, or minus the number of the signal that ended it.
        tail: the last lines it wrote.
        log: file with all lines.
    """

    name: str
    code: int
    tail: tuple[str, ...]
    log: Path

    def __str__(self) -> str:
        reason = f"exit code {self.code}" if self.code >= 0 else f"killed by {signal.Signals(-self.code).name}"
        lines = "".join(f"\n    {line}" for line in self.tail)
        last = f". Its last lines ({self.log}):{lines}" if lines else f" without a word ({self.log})"
        return f"{self.name} ended: {reason}{last}"


class RunningProgram:
    """A started program. It is terminated when the process (strictly: the thread) that started it ends.

    It has its own process group, so that Ctrl-C in the terminal does not reach it, but stays in the session: Linux shares
    processors between sessions first (autogroups), so that in a session of its own its niceness would have no effect on others.

    Args:
        program: what to start.
        log: file for its output.
        environment: its environment variables.
        on_line: called with (name, line) for each line of output, from a separate thread.
    """

    def __init__(self, program: Program, log: Path, environment: Mapping[str, str], on_line: Callable[[str, str], None]) -> None:
        self.program = program
        self._log = log
        self._on_line = on_line
        self._tail: deque[str] = deque(maxlen=_TAIL)
        self._read_lines = 0
        self._process = subprocess.Popen(
            [*_die_with_parent(), *program.command], env=dict(environment), process_group=0,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace")
        self._reader = threading.Thread(target=self._read, name=f"log {program.name}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process id, which is the id of the process group too."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the whole process group."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds for its end; return whether it has ended."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def ending(self) -> Ending:
        """Wait for its end and return how it ended."""
        code = self._process.wait()
        while self._reader.is_alive():  # to its last words; a grandchild may hold the pipe open, and is not waited for
            read = self._read_lines
            self._reader.join(1.0)
            if self._read_lines == read:
                break
        return Ending(self.program.name, code, tuple(self._tail), self._log)

    def _read(self) -> None:
        """Read all output, even if the log cannot be written: a full pipe would block the program, a closed one would end it."""
        assert self._process.stdout is not None
        with self._process.stdout as stream, ExitStack() as stack:
            file = None
            with suppress(OSError):
                file = stack.enter_context(self._log.open("wb", buffering=0))
            for line in stream:
                with suppress(OSError):
                    if file is not None:
                        file.write(line.encode())
                self._tail.append(line.rstrip())
                self._read_lines += 1
                self._on_line(self.program.name, line.rstrip())


def _die_with_parent() -> tuple[str, ...]:
    """Return a command prefix by which the kernel terminates the program when its parent ends; empty without `setpriv`."""
    setpriv = shutil.which("setpriv")
    return (setpriv, "--pdeathsig", "TERM", "--") if setpriv else ()
