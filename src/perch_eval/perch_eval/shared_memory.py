"""Removal of the shared memory that killed ROS processes leave behind.

Fast DDS removes its segments when a process ends by itself. A killed process leaves up to some megabytes in
`/dev/shm`, which accumulate. Segments are removed only if our own processes were observed to use them, and
if no process uses them or their creator has ended: a participant that does not notice that end keeps such a
segment mapped until its own process ends.
"""

from __future__ import annotations

import fcntl
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

PORT = re.compile(r"(?:sem\.)?fast\w+_port(\d+)")
_FOLDER = Path("/dev/shm")
_SEGMENT = re.compile(r"(/dev/shm/(?:sem\.)?fast(?:rtps|dds)_\S+)")


class SharedMemory:
    """The segments of a group of processes.

    Args:
        proc: the process file system.

    Attributes:
        seen: the remembered segments.
    """

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._proc = proc
        self.seen: set[str] = set()

    def observe(self, pids: Iterable[int]) -> None:
        """Remember the segments that these processes use now."""
        for pid in pids:
            self.seen |= self._used_by(self._proc / str(pid))

    def clean(self) -> list[str]:
        """Remove the remembered segments that no process uses, or whose creator has ended, with their lock files. One that is
        re-created meanwhile by a process about to end is removed by the next call.

        Returns:
            The files that were removed.
        """
        if not self.seen:
            return []
        removed = []
        for segment in sorted(self.unused(self.seen)):
            mutex = Path(segment).with_name(f"sem.{Path(segment).name}_mutex")  # stays after a process that ended by itself, too
            for file in (Path(segment), Path(f"{segment}_el"), Path(f"{segment}_sl"), mutex):
                with suppress(OSError):  # gone already, or another user's
                    file.unlink()
                    removed.append(str(file))
        return removed

    def unused(self, segments: Iterable[str]) -> set[str]:
        """Return the segments that no process uses now, or whose creator has ended."""
        used = {segment for process in self._proc.glob("[0-9]*") for segment in self._used_by(process)}
        return {segment for segment in segments if segment not in used or _abandoned(Path(segment))}

    @staticmethod
    def _used_by(process: Path) -> set[str]:
        try:
            return set(_SEGMENT.findall((process / "maps").read_text()))
        except OSError:  # the process has ended, or belongs to somebody else
            return set()


def ports(domain: int) -> range:
    """The UDP ports of a ROS domain (DDSI-RTPS 2.5, 9.6.2.3)."""
    return range(7400 + 250 * domain, 7400 + 250 * (domain + 1))


def of_ports(domain: int) -> set[Path]:
    """Return the files, with locks, of the segments in which the ports of a ROS domain receive."""
    return {file for file in _FOLDER.glob("*fast*_port*") if (of := PORT.match(file.name)) and int(of[1]) in ports(domain)}


def segment(file: Path) -> str:
    """Return the segment of a file: the file itself, or the segment that it locks."""
    return str(file.with_name(re.sub(r"^sem\.|_[es]l$|_mutex$", "", file.name)))


def _abandoned(segment: Path) -> bool:
    """Return whether the creator of a segment has ended: until then Fast DDS holds the lock of the file `<segment>_el`."""
    if PORT.match(segment.name):  # the next participant takes it over
        return False
    try:
        with Path(f"{segment}_el").open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    except OSError:  # it is held, or there is none
        return False
