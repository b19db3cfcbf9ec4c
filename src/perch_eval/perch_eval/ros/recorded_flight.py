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
        restart = ""
        last: dict[str, int] = {}    # time of the last message of each channel [ns]
        restarted: set[str] = set()  # channels whose time has gone back at the last restart
        for topic, type_of, time, data in read(path, on_damage=damage.append):
            key = topic.removeprefix(prefix).lstrip("/")
            channel = _channel(key, type_of)
            if channel is not None and (topic.startswith(prefix) or channel.startswith("/")):
                if time < last.get(key, time) - RESTART:
                    if key in STREAMS and (key in restarted or not restarted):
                        self._undecoded = {name: found for name, found in self._undecoded.items() if name == "robot_description"}
                        last, restarted = {}, {key}
                        restart = f"time has restarted: only what follows the last restart, at {1e-9 * time:.3f} s, is read"
                    elif restarted and key not in restarted:  # messages of before that were written after the first one of another channel
                        self._undecoded.pop(key, None)
                        restarted.add(key)
                last[key] = time
                self._undecoded.setdefault(key, (channel, []))[1].append((time, data))
        super().__init__({key: [] for key in self._undecoded}, str(path), "; ".join(filter(None, [restart, *damage])))

    def values(self, channel: str) -> list[tuple[float, Any]]:
        """Return (time [s], value) of a channel in order; its messages are decoded at the first call."""
        if channel in self._undecoded:
            self._channels[channel] = list(_decoded(*self._undecoded[channel]))
            del self._undecoded[channel]
        return super().values(channel)


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
