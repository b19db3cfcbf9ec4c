"""Ends shared-memory segments that a killed process left unfinished: Fast DDS 2.14 waits without end for their maker.

A segment begins with a word of state (`managed_open_or_create_impl` of Boost.Interprocess). Who opens one waits while that word says
"uninitialized" or "initializing", and goes on without it where it says "corrupted". Making one takes microseconds.
"""

from __future__ import annotations

import re
import time
from contextlib import suppress
from pathlib import Path

FOLDER = Path("/dev/shm")
PORT = re.compile(r"fast(?:rtps|dds)_port\d+")
"""Segments that any process may make: in which a participant receives. The others are made before anybody is told of them."""
INITIALIZED, CORRUPTED = 2, 3
PATIENCE = 1.0  # after which the maker of an unfinished segment is taken for dead [s]


def end_unfinished(folder: Path = FOLDER) -> list[Path]:
    """Mark unfinished segments as corrupted, so that who waits for them goes on, and remove them.

    Waits up to `PATIENCE` where one has just been begun, so that nobody waits longer who calls this first.

    Returns:
        What was removed.
    """
    removed = []
    for file in folder.iterdir() if folder.is_dir() else ():
        with suppress(OSError):  # gone already, or another user's
            if PORT.fullmatch(file.name) and _unfinished(file):
                time.sleep(max(0.0, PATIENCE - (time.time() - file.stat().st_mtime)))
                if _unfinished(file):
                    with file.open("r+b") as segment:
                        segment.write(CORRUPTED.to_bytes(4, "little"))
                    file.unlink()
                    removed.append(file)
    return removed


def _unfinished(file: Path) -> bool:
    with file.open("rb") as segment:
        return int.from_bytes(segment.read(4), "little") < INITIALIZED
