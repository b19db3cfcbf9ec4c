"""Start of nodes in a tenth of a second, by forking each from a process that has loaded their code. Independent of ROS.

An ordinary start takes seconds of processor time for imports and compiled code, and campaigns over ROS start thousands of nodes.
The fork server of `multiprocessing` forks each node into a process with its own session, sockets, shared memory, signals and log.
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
    """Start a node, which is killed when this process ends.

    Args:
        what: `module:name` of something with `main()`, or of a function.
        arguments: of the node's command line.
        log: file that receives its output.
        environment: variables in addition to the caller's.
        preload: module that the fork server loads before the first node is started.

    Returns:
        Process id of the node, which is also the id of its session.

    Raises:
        PerchError: the fork server has ended.
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
    """Return whether a process exists and has not ended; a stopped one counts as alive."""
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
    """Turn the forked process into the node and run it."""
    from perch_eval import ended_with_caller  # loaded in the fork server alone: its import ends a process with its parent

    os.setsid()
    end_with_parent(signal.SIGKILL, ended_with_caller.SERVER)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    file, nothing = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), os.open(os.devnull, os.O_RDONLY)
    for target, source in ((0, nothing), (1, file), (2, file)):
        os.dup2(source, target)
    os.environ.update(environment)
    sys.argv = [what, *arguments]
    found = resolved(what)
    getattr(found, "main", found)()
