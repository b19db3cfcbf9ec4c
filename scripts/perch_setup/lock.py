"""Lock by which one process at a time sets up; the others wait, then find the work done."""

from __future__ import annotations

import contextlib
import fcntl
import sys
from typing import Iterator

from .layout import STATE

_descriptors: list[int] = []


def descriptors() -> tuple[int, ...]:
    """Return the file descriptors of the lock, to be passed on to pip and colcon.

    The kernel releases the lock when its last holder ends. As the tools hold it as well, the lock of a killed
    set-up is kept until they have ended, and the next set-up does not write to the same files.
    """
    return tuple(_descriptors)


@contextlib.contextmanager
def setup_lock() -> Iterator[None]:
    """Hold the lock of this repository's set-up."""
    STATE.mkdir(exist_ok=True)
    with (STATE / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print("perch set-up: another process is setting up; waiting for it", file=sys.stderr)
            fcntl.flock(file, fcntl.LOCK_EX)
        _descriptors.append(file.fileno())
        try:
            yield
        finally:
            _descriptors.clear()
