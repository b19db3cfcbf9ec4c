"""Lets one process at a time set up; the others wait, then find the work done."""

from __future__ import annotations

import contextlib
import fcntl
import sys
from typing import Iterator

from .layout import STATE

_held: list[int] = []


def held() -> tuple[int, ...]:
    """File descriptors of the lock, to be passed on to pip and colcon.

    The kernel frees the lock when the last holder ends. With its tools among the holders, a killed
    set-up keeps the lock until they have ended too, and the next one does not write where they write.
    """
    return tuple(_held)


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Hold the lock of this repository's set-up."""
    STATE.mkdir(exist_ok=True)
    with (STATE / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print("perch set-up: another process is setting up; waiting for it", file=sys.stderr)
            fcntl.flock(file, fcntl.LOCK_EX)
        _held.append(file.fileno())
        try:
            yield
        finally:
            _held.clear()
