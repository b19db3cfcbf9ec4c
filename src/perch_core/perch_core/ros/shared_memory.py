"""Removal of shared-memory segments that a killed process left unfinished: Fast DDS 2.14 waits for ever for their creator.

A segment begins with a state word (`managed_open_or_create_impl` of Boost.Interprocess). A process that opens a segment waits
while the state is "uninitialized" or "initializing", and continues without it if it is "corrupted". Creation takes microseconds.
"""

from __future__ import annotations

import re
import time
from contextlib import suppress
from pathlib import Path

FOLDER = Path("/dev/shm")
PORT = re.compile(r"fast(?:rtps|dds)_port\d+")
"""Names of segments that any process may create: those in which participants receive. Others are announced once complete."""
INITIALIZED, CORRUPTED = 2, 3
CREATION_TIMEOUT = 1.0  # after which the creator of an unfinished segment is considered dead [s]


def remove_unfinished_segments(folder: Path = FOLDER) -> list[Path]:
    """Mark unfinished segments as corrupted, so that waiting processes continue, and remove them.

    Waits up to `CREATION_TIMEOUT` for a segment that was created just before; a caller that does this first
    waits no longer than that.

    Returns:
        The removed files.
    """
    removed = []
    for file in folder.iterdir() if folder.is_dir() else ():
        with suppress(OSError):  # gone already, or another user's
            if PORT.fullmatch(file.name) and _unfinished(file):
                age = time.time() - file.stat().st_mtime  # negative where the clock was set back
                time.sleep(min(max(0.0, CREATION_TIMEOUT - age), CREATION_TIMEOUT))
                if _unfinished(file):
                    with file.open("r+b") as segment:
                        segment.write(CORRUPTED.to_bytes(4, "little"))
                    file.unlink()
                    removed.append(file)
    return removed


def _unfinished(file: Path) -> bool:
    with file.open("rb") as segment:
        return int.from_bytes(segment.read(4), "little") < INITIALIZED
