"""Starts nodes in a tenth of a second: each process is forked from one that has loaded their code. Independent of ROS.

A node's own start takes seconds of processor time for imports and compiled code, campaigns over ROS start thousands. What is forked, by
the fork server of `multiprocessing`, is a process of its own: its own session, sockets, shared memory, signals and log.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import psutil
from perch_core.errors import PerchError
from perch_core.processes import end_with_parent
from perch_core.registry import resolved


def start(what: str, arguments: Sequence[str], log: Path, environment: Mapping[str, str], preload: str) -> int:
    """Start a node, which ends with this process.

    Args:
        what: `module:name` of something with `main()`, or of a function.
        arguments: of its command line.
        log: receives what it writes.
        environment: on top of the caller's.
        preload: module that is loaded before this process starts its first node.

    Returns:
        Its process id, which leads a session of its own.

    Raises:
        PerchError: the process that forks has ended.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["perch_eval.ended_with_caller", preload])
    process = context.Process(target=_run_node, args=(what, tuple(arguments), log, dict(environment)))
    try:
        process.start()
    except (OSError, EOFError) as error:
        raise PerchError(f"the process that starts nodes has ended ({error or 'while it loaded their code'})") from None
    assert process.pid is not None
    return process.pid


def alive(pid: int) -> bool:
    """Whether a process runs, or is stopped."""
    with suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    return False


def session(leader: int) -> list[int]:
    """The living processes of a session."""
    found = []
    for pid in psutil.pids():
        with suppress(OSError):
            if os.getsid(pid) == leader and alive(pid):
                found.append(pid)
    return found


def _run_node(what: str, arguments: tuple[str, ...], log: Path, environment: dict[str, str]) -> None:
    """Run the node in the forked process."""
    os.setsid()
    end_with_parent(signal.SIGKILL)
    caller = multiprocessing.parent_process()
    if caller is not None and not caller.is_alive():  # and the fork server with it, before `end_with_parent` took effect
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    file, nothing = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), os.open(os.devnull, os.O_RDONLY)
    for target, source in ((0, nothing), (1, file), (2, file)):
        os.dup2(source, target)
    os.environ.update(environment)
    sys.argv = [what, *arguments]
    found = resolved(what)
    getattr(found, "main", found)()
