"""Reservation of ROS domains, which isolates flights and tests on one machine from each other."""

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
from perch_core.ros.shared_memory import end_unfinished
from perch_eval.shared_memory import ports

USABLE = range(43, 102)
"""Ids up to 101 keep the ports below Linux's ephemeral ones; 42 is the default of `setup.bash`, smaller ids are left to users."""
_given: list[int] = []
"""The domains that this process has reserved, in order."""


@contextlib.contextmanager
def reserved_domain(candidates: Iterable[int] | None = None, folder: Path | None = None) -> Iterator[int]:
    """Reserve a domain id that is not reserved on this machine and has no participants.

    The kernel releases the reservation when the process ends, however it ends.

    Args:
        candidates: ids to choose from, best first; by default all usable ones.
        folder: of the lock files; by default one in the machine's folder for temporary files.

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
            _given.append(candidate)
            end_unfinished()
            yield candidate
            return
    raise PerchError(f"every ROS domain is reserved (lock files in {folder}): end another flight or test first")


@contextlib.contextmanager
def own_domain(candidates: Iterable[int] | None = None) -> Iterator[int]:
    """Reserve a domain and use it in this process and its children (ROS_DOMAIN_ID) until the context ends."""
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
    """Reserve a domain id until this process ends."""
    stack = contextlib.ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(reserved_domain())


def _spread() -> list[int]:
    """Return the usable ids in the order to try: from the one after the last reserved, as destroyed nodes stay in the graph for a
    while; at first from one that depends on the process, as users tend to choose small ones."""
    start = USABLE.index(_given[-1]) + 1 if _given and _given[-1] in USABLE else os.getpid() % len(USABLE)
    return [*USABLE[start:], *USABLE[:start]]
