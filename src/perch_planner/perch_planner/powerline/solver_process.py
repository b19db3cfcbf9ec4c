"""The planning process: a supervisor that keeps everything warm, and a child that solves and may be killed.

When the child does not answer in time, the supervisor kills it and forks the next from its own memory, which takes
milliseconds where a new Python with CasADi takes seconds. Run by `worker.PowerlineWorker`, never by hand.
"""

from __future__ import annotations

import os
import select
import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from typing import Any

from perch_core.errors import PlanningRefusal
from perch_core.processes import end_with_parent
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.worker import Job, Refusal, Setup


def _answer(planner: PowerlinePlanner, request: PowerlineRequest) -> Any:
    try:
        return planner.plan(request)
    except PlanningRefusal as refusal:
        return Refusal.of(refusal)
    except Exception as error:  # the caller must get an answer whatever happens here
        return Refusal("solver", type(error).__name__, -1.0, f"planning failed: {type(error).__name__}: {error}")


def _child(planner: PowerlinePlanner, pipe: Connection) -> None:
    """Solve requests until the pipe closes."""
    end_with_parent(signal.SIGKILL)
    while True:
        try:
            request = pipe.recv()
        except EOFError:
            os._exit(0)
        pipe.send(_answer(planner, request))


def _fork(planner: PowerlinePlanner, upstream: Connection) -> tuple[int, Connection]:
    mine, theirs = Pipe()
    pid = os.fork()
    if pid == 0:
        mine.close(), upstream.close()
        _child(planner, theirs)
    theirs.close()
    return pid, mine


def supervise(upstream: Connection, make: Callable[..., PowerlinePlanner] = PowerlinePlanner) -> None:
    """Answer the jobs that come down a pipe until it closes.

    Args:
        upstream: the caller's pipe: a `Setup`, then `Job`s.
        make: planner of vehicle, settings and gravity.
    """
    setup: Setup = upstream.recv()
    try:
        planner = make(setup.vehicle, setup.settings, setup.gravity)
        planner.warm_up()
    except Exception as error:  # reported to the caller, who raises it
        upstream.send(f"{type(error).__name__}: {error}")
        return
    pid, child = _fork(planner, upstream)
    upstream.send("ready")
    while True:
        try:
            job: Job = upstream.recv()
        except EOFError:
            os.kill(pid, signal.SIGKILL)
            return
        child.send(job.request)
        # Also wake when the caller goes away while the child is at work.
        ready, _, _ = select.select([child, upstream], [], [], job.limit)
        if child in ready:
            try:
                upstream.send_bytes(child.recv_bytes())
                continue
            except EOFError:
                upstream.send(Refusal("solver", "worker", -1.0, "the solver crashed"))
        elif upstream in ready:
            os.kill(pid, signal.SIGKILL)
            return
        else:
            upstream.send(Refusal("deadline", "wall-clock time", -1.0, "the solver was stopped"))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        child.close()
        pid, child = _fork(planner, upstream)


def main(make: Callable[..., PowerlinePlanner] = PowerlinePlanner) -> None:
    """Serve the pipe whose number is the last argument of the command line."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller decides when this ends
    # No parent-death signal here: Linux sends it when the *thread* that started this process ends. The pipe's end is enough.
    supervise(Connection(int(sys.argv[-1])), make)


if __name__ == "__main__":
    main()
