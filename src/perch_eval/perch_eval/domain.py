"""Reserves ROS domains, so that flights and tests on one machine do not receive each other's messages."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import psutil

from perch_core.errors import PerchError
from perch_core.ros.shared_memory import remove_unfinished_segments
from perch_eval.shared_memory import ports

USABLE = range(43, 102)
"""Up to 101 the ports stay below Linux's ephemeral ones; 42 is the default of `setup.bash`, smaller ones are people's."""
_reserved: list[int] = []
"""The domains that this process has reserved, in order."""


@contextlib.contextmanager
def reserved_domain(candidates: Iterable[int] | None = None, folder: Path | None = None) -> Iterator[int]:
    """A domain id that no other reservation on this machine holds, and that has no participants.

    The kernel gives it back when the process ends, however it ends.

    Args:
        candidates: ids to choose from, best first; by default all usable ones.
        folder: where the lock files lie; by default the machine's folder for temporary files.

    Raises:
        PerchError: every candidate is taken.
    """
    folder = folder or Path(tempfile.gettempdir()) / f"perch-domains-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    for candidate in _spread() if candidates is None else candidates:
        with (folder / str(candidate)).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if participants(candidate):
                continue
            _reserved.append(candidate)
            remove_unfinished_segments()
            yield candidate
            return
    raise PerchError(f"every ROS domain is reserved (lock files in {folder}): end another flight or test first")


@contextlib.contextmanager
def domain_in_environment(candidates: Iterable[int] | None = None) -> Iterator[int]:
    """A `reserved_domain` that this process and its children use meanwhile, by `ROS_DOMAIN_ID`."""
    before = os.environ.get("ROS_DOMAIN_ID")
    try:
        with reserved_domain(candidates) as domain:
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            yield domain
    finally:
        os.environ.pop("ROS_DOMAIN_ID", None) if before is None else os.environ.update(ROS_DOMAIN_ID=before)


def participants(domain: int) -> list[int]:
    """UDP ports of a domain that are bound on this machine."""
    return sorted({socket.laddr.port for socket in psutil.net_connections("udp") if socket.laddr and socket.laddr.port in ports(domain)})


def free_domain() -> int:
    """A domain id that this process keeps to itself until it ends."""
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(reserved_domain())


def _spread() -> list[int]:
    """The usable ids, from another one on in each process (people who choose by hand begin with the small ones), and after the
    last one: nodes that have been destroyed stay in the graph for a while."""
    start = USABLE.index(_reserved[-1]) + 1 if _reserved and _reserved[-1] in USABLE else os.getpid() % len(USABLE)
    return [*USABLE[start:], *USABLE[:start]]
