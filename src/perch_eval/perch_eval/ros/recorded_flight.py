"""Flights read from, and written to, MCAP files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_eval.flight import Flight, time_of
from perch_eval.mcap_log import McapLog, read
from perch_eval.ros.definitions import schema_of, type_name


STREAMS = ("ground_truth/odometry", "imu/data_raw", "odometry")  # channels whose time never goes back within a flight
RESTART = 1_000_000_000  # by which it goes back where time has restarted [ns]


class RecordedFlight(Flight):
    """The flight of an MCAP file, as the recorder or rosbag2 writes them. Only channels of `perch_core.ros.topics` are read.

    Where time has restarted during the recording, `damage` says so, and the flight is what follows the last restart.
    """

    def __init__(self, path: Path, namespace: str = "") -> None:
        """
        Args:
            path: the file; a truncated one is read as far as possible.
            namespace: of the vehicle, where several were recorded.
        """
        prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        self._undecoded: dict[str, tuple[str, list[tuple[int, bytes]]]] = {}  # channel and messages that have not been requested
        damage: list[str] = []
        restarts = _Restarts()
        for topic, type_of, time, data in read(path, on_damage=damage.append):
            key = topic.removeprefix(prefix).lstrip("/")
            channel = _channel(key, type_of)
            if channel is None or not (topic.startswith(prefix) or channel.startswith("/")):
                continue
            for earlier in restarts.outdated(key, time, self._undecoded):
                self._undecoded.pop(earlier, None)
            self._undecoded.setdefault(key, (channel, []))[1].append((time, data))
        super().__init__({key: [] for key in self._undecoded}, str(path), "; ".join(filter(None, [restarts.message, *damage])))

    def values(self, channel: str) -> list[tuple[float, Any]]:
        """Return (time [s], value) of a channel in order; its messages are decoded at the first call."""
        if channel in self._undecoded:
            self._channels[channel] = list(_decoded(*self._undecoded[channel]))
            del self._undecoded[channel]
        return super().values(channel)


class _Restarts:
    """Search for restarts of time among the messages of a recording, in the order of the file.

    Attributes:
        message: about the last restart; empty: there was none.
    """

    def __init__(self) -> None:
        self.message = ""
        self._last: dict[str, int] = {}   # time of the last message of each channel [ns]
        self._restarted: set[str] = set()  # channels whose time has gone back at the last restart

    def outdated(self, key: str, time: int, known: Iterable[str]) -> list[str]:
        """Take the next message's channel and time [ns]; return those of the known channels whose messages until then are of an
        earlier flight."""
        gone_back = time < self._last.get(key, time) - RESTART
        self._last[key] = time
        if gone_back and key in STREAMS and (key in self._restarted or not self._restarted):
            self._last, self._restarted = {key: time}, {key}
            self.message = f"time has restarted: only what follows the last restart, at {1e-9 * time:.3f} s, is read"
            return [one for one in known if one != "robot_description"]
        if gone_back and self._restarted and key not in self._restarted:
            self._restarted.add(key)
            return [key]  # messages of before that were written after the first one of another channel
        return []


def _decoded(channel: str, messages: list[tuple[int, bytes]]) -> Iterator[tuple[float, Any]]:
    for logged, data in messages:
        try:
            value = topics.decode(channel, data)
        except (PerchError, LookupError):  # as the component that it was for dropped it; or an empty list of transforms
            continue
        time = time_of(value)
        yield 1e-9 * logged if time is None else time, value


@lru_cache(maxsize=None)
def _channel(key: str, type_of: str) -> str | None:
    """Return the channel of `perch_core.ros.topics` for a topic, if there is one with this type."""
    for channel in (key, f"/{key}"):
        try:
            if type_name(topics.message_type(channel)) == type_of:
                return channel
        except PerchError:
            continue
    return None


def write(path: Path, values: Iterable[tuple[str, int, Any]], namespace: str = "") -> None:
    """Write values to an MCAP file, in the recorder's format.

    Args:
        path: the file.
        values: (channel, time [ns], value) in the order of the file.
        namespace: of the vehicle.
    """
    with closing(McapLog(path)) as log:
        for channel, time, value in values:
            topic = channel if channel.startswith("/") else f"{namespace}/{channel}"
            log.write(topic, schema_of(topics.message_type(channel)), topics.encode(channel, value), time)
