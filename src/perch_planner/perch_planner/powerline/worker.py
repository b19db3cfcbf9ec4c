"""Planning in a process that can be killed: a solver that hangs costs its deadline, never the node. [P:V]

This is the caller's side; `solver_process` is the other one.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, Pipe
from typing import Any

from perch_core.errors import PerchError, PlanningRefusal
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline.plan import PowerlinePlan
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

FALLBACK_SHARE = 0.6  # of the deadline: when the first solver has not answered by then, ipopt gets the rest
COMMAND = (sys.executable, "-m", "perch_planner.powerline.solver_process")
START_TIMEOUT = 120.0  # a first start compiles the stage functions [s]


@dataclass(frozen=True)
class Setup:
    """What a planning process is about; the first thing it is sent."""

    vehicle: Vehicle
    settings: PowerlineSettings
    gravity: float


@dataclass(frozen=True)
class Refusal:
    """A PlanningRefusal as it crosses the pipe: exceptions with several arguments do not survive pickling."""

    code: str
    constraint: str
    margin: float
    message: str

    @classmethod
    def of(cls, refusal: PlanningRefusal) -> Refusal:
        return cls(refusal.code, refusal.constraint, refusal.margin, str(refusal))

    def error(self) -> PlanningRefusal:
        return PlanningRefusal(self.code, self.constraint, self.margin, self.message)


@dataclass(frozen=True)
class Job:
    """One plan to make, and the time after which it is stopped [s]."""

    request: PowerlineRequest
    limit: float


class PowerlineWorker:
    """Plans in another process, each plan within a deadline.

    Building one returns at once; call `wait_ready` before the first plan, which otherwise is likely to be refused, as the
    start counts towards its deadline. `close` ends the processes, and so
    does the end of the caller.
    """

    def __init__(self, vehicle: Vehicle, settings: PowerlineSettings | None = None, gravity: float = GRAVITY,
                 command: tuple[str, ...] = COMMAND) -> None:
        """
        Args:
            vehicle: plans are for it.
            settings: of every plan.
            gravity: [m/s^2].
            command: starts the planning process; the number of its end of the pipe is appended.
        """
        self._command = command
        self._settings = settings or PowerlineSettings()
        self._setup = Setup(vehicle, self._settings, gravity)
        self._lock = threading.Lock()
        self._process: subprocess.Popen | None = None
        self._start()

    def _start(self) -> None:
        self._ready = False
        mine, theirs = Pipe()
        command = [*self._command, str(theirs.fileno())]
        self._process = subprocess.Popen(command, pass_fds=(theirs.fileno(),), process_group=0)
        theirs.close()
        self._pipe: Connection = mine
        self._pipe.send(self._setup)

    def wait_ready(self, timeout: float = START_TIMEOUT) -> bool:
        """Wait until the supervisor has loaded (and, the first time on a machine, compiled) everything.

        Raises:
            PerchError: it could not; the message says why.
        """
        if not self._ready and self._pipe.poll(timeout):
            answer = self._receive()
            if answer != "ready":
                raise PerchError(f"powerline worker: {answer}")
            self._ready = True
        return self._ready

    @property
    def pid(self) -> int:
        """Process id of the supervisor, which leads its own session."""
        return self._process.pid

    def _receive(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, OSError):
            self.close()  # the next plan starts another
            return Refusal("solver", "worker", -1.0, "the planning process ended unexpectedly")

    def plan(self, request: PowerlineRequest, deadline: float | None = None) -> PowerlinePlan:
        """Plan within a deadline.

        Args:
            request: what to plan.
            deadline: wall-clock limit [s]; the settings' when None.

        Raises:
            PlanningRefusal: as `PowerlinePlanner.plan`, or code deadline or solver.
        """
        limit = self._settings.deadline if deadline is None else float(deadline)
        if not limit > 0:
            raise PlanningRefusal("bad_input", "deadline", limit, f"deadline {limit:g} s is not > 0 s")
        begin = time.monotonic()
        with self._lock:
            if self._process.poll() is not None:
                self.close()
                self._start()
            if not self.wait_ready(limit):
                raise PlanningRefusal("deadline", "start", -limit, f"the planner was not ready after {limit:g} s; ask again")
            first = request.solver or self._settings.solver
            share = FALLBACK_SHARE if first != "ipopt" else 1.0
            answer = self._ask(Job(request, share * limit))
            left = limit - (time.monotonic() - begin)
            hung = isinstance(answer, Refusal) and answer.code == "deadline"
            if hung and share < 1.0 and left > 0.05:
                answer = self._ask(Job(replace(request, solver="ipopt"), left))
        if isinstance(answer, Refusal):
            if answer.code == "deadline":
                raise PlanningRefusal("deadline", "wall-clock time", -1.0,
                                      f"no plan within {limit:g} s: the solver was stopped; allow more time or start from elsewhere")
            raise answer.error()
        return answer

    def _ask(self, job: Job) -> Any:
        try:
            self._pipe.send(job)
        except OSError:
            return Refusal("solver", "worker", -1.0, "the planning process ended unexpectedly")
        # The supervisor keeps the limit; the grace is for the case that it hangs itself.
        if not self._pipe.poll(job.limit + 1.0):
            self.close()
            return Refusal("deadline", "wall-clock time", -1.0, "the planning process did not answer")
        return self._receive()

    def close(self) -> None:
        """End the processes. A plan that another thread waits for is refused."""
        if self._process.poll() is None:
            try:
                os.killpg(self._process.pid, signal.SIGKILL)  # its own group: supervisor and child
            except ProcessLookupError:
                pass
        self._process.wait()
        self._pipe.close()  # last: who waits at it sees its other end close, but not this one
