"""Start, monitoring and stop of a group of programs, each in its own process group. Independent of ROS."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_eval.program import Ending, Program, RunningProgram
from perch_eval.shared_memory import SharedMemory

_ESCALATION = ((signal.SIGINT, 5.0), (signal.SIGTERM, 1.0), (signal.SIGKILL, 1.0))
"""Signals to stop programs with, and time-out of each [s]: on a busy machine, finishing a recording may take seconds."""
_AT_START = ((signal.SIGTERM, 0.5), (signal.SIGKILL, 1.0))
"""The same while programs load and compile: they have nothing to finish, and on SIGINT Python would print a traceback."""
_POLL_S = 0.02


class StackError(PerchError):
    """Raised when a program cannot be started, ends unexpectedly, or does not become ready.

    Attributes:
        endings: the programs that ended.
    """

    def __init__(self, message: str, endings: Sequence[Ending] = ()) -> None:
        super().__init__(message)
        self.endings = tuple(endings)

    @property
    def callers_mistake(self) -> bool:
        """Whether a program refused its arguments or parameters (exit code 2)."""
        return any(ending.code == 2 for ending in self.endings)


class Stack:
    """A group of programs, started together and stopped together.

    Use it as a context manager: at the end of its block, all programs are stopped, also after exceptions. The thread
    that starts it must outlive it.

    Args:
        programs: what to start, in order.
        log_dir: receives `<program>.log` of each.
        on_line: called with (program name, line) for each line of output, from several threads.
    """

    def __init__(self, programs: Sequence[Program], log_dir: Path, on_line: Callable[[str, str], None] = lambda name, line: None) -> None:
        self._programs = tuple(programs)
        self._log_dir = log_dir
        self._environment = {**os.environ, "PYTHONUNBUFFERED": "1", "ROS_LOG_DIR": str(log_dir)}
        self._on_line = on_line
        self._memory = SharedMemory()
        self._ready = False
        self._started: dict[str, RunningProgram] = {}

    def __enter__(self) -> Stack:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start every program.

        Raises:
            StackError: a program cannot be started.
        """
        self._log_dir.mkdir(parents=True, exist_ok=True)
        for program in self._programs:
            if shutil.which(program.command[0]) is None:
                raise StackError(f"{program.name} cannot be started: there is no executable {program.command[0]}")
            log = self._log_dir / f"{program.name}.log"
            try:
                with _deferred_signals():  # an interrupt within Popen would leave a program that nobody stops
                    self._started[program.name] = RunningProgram(program, log, self._environment, self._on_line)
            except OSError as error:
                raise StackError(f"{program.name} cannot be started: {error}") from None

    @property
    def pids(self) -> dict[str, int]:
        """Process id of each running program."""
        return {name: running.pid for name, running in self._started.items() if running.running}

    def endings(self) -> tuple[Ending, ...]:
        """The programs that have ended so far."""
        return tuple(running.ending() for running in self._started.values() if not running.running)

    def wait_until_ready(self, visible: Callable[[], set[str]], timeout: float = 20.0) -> None:
        """Wait until every node of every program is visible.

        Args:
            visible: fully qualified names of the nodes in the graph.
            timeout: wall-clock seconds to wait at most.

        Raises:
            StackError: a program ended meanwhile, or its nodes do not appear.
        """
        wanted = {node for program in self._programs for node in program.nodes}
        last = time.monotonic() + timeout
        while not wanted <= (seen := visible()):
            self.raise_if_ended()
            if time.monotonic() > last:
                missing = ", ".join(sorted(wanted - seen))
                raise StackError(f"not ready after {timeout:g} s: {missing}. Logs: {self._log_dir}")
            time.sleep(_POLL_S)
        self.raise_if_ended()
        self._ready = True
        self._memory.observe((*self.pids.values(), os.getpid()))

    def wait(self) -> tuple[Ending, ...]:
        """Wait until a program ends; return those that have ended."""
        while not (endings := self.endings()):
            time.sleep(_POLL_S)
        return endings

    def raise_if_ended(self) -> None:
        """Raise StackError, with reason and last lines, where a program has ended."""
        if endings := self.endings():
            raise StackError("\n".join(str(ending) for ending in endings), endings)

    def stop(self) -> dict[str, Ending]:
        """Stop all programs: interrupt, then terminate, then kill. It may be called repeatedly.

        In the main thread it is not interrupted by a second Ctrl-C.

        Returns:
            How each program ended.
        """
        with _handled_by(signal.SIG_IGN):
            self._memory.observe(self.pids.values())
            for number, patience in _ESCALATION if self._ready else _AT_START:
                running = [program for program in self._started.values() if program.running]
                for program in running:
                    program.signal(number)
                deadline = time.monotonic() + patience
                for program in running:
                    program.wait(max(0.0, deadline - time.monotonic()))
            for program in self._started.values():
                program.signal(signal.SIGKILL)  # what a program may have left in its group
            endings = {name: program.ending() for name, program in self._started.items()}
            self._memory.clean()
            return endings


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Defer SIGINT and SIGTERM until the block has ended."""
    received: list[int] = []
    try:
        with _handled_by(lambda number, _: received.append(number)):
            yield
    finally:
        for number in received[:1]:
            signal.raise_signal(number)


@contextmanager
def _handled_by(handler: Any) -> Iterator[None]:
    """Handle SIGINT and SIGTERM by `handler` within the block, in the main thread; other threads receive no signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former or signal.SIG_DFL)
