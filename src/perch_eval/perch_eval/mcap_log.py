"""MCAP files with ROS 2 messages, as rosbag2 and Foxglove read them. (rosbag2_py is not among the PyPI wheels.)"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from os import SEEK_END
from pathlib import Path
from typing import NamedTuple

import mcap.records
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.stream_reader import CRCValidationError
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from zstandard import ZstdError


class Schema(NamedTuple):
    """A message type: `package/msg/Name`, and its definition with those of everything it contains."""

    name: str
    definition: str


class McapLog:
    """Writes serialised messages to a file. If the process is killed or the disk is full, all but the last chunk is readable."""

    def __init__(self, path: Path) -> None:
        """
        Raises:
            OSError: the file cannot be written.
        """
        self._file = open(path, "wb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD, chunk_size=256 * 1024)
        self._writer.start(profile="ros2", library="perch")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self, topic: str, schema: Schema, data: bytes, time: int) -> None:
        """Append one message of a topic; the first one declares the topic's type. `time` is simulation time [ns].

        Raises:
            OSError: the disk is full, or gone.
        """
        if topic not in self._channels:
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(schema.name, "ros2msg", schema.definition.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[schema.name])
        self._writer.add_message(self._channels[topic], log_time=time, publish_time=time, data=data)

    def flush(self) -> None:
        """Hand the finished chunks to the operating system.

        Raises:
            OSError: as `write`.
        """
        self._file.flush()

    def close(self) -> None:
        """Write the index and close the file.

        Raises:
            OSError: as `write`.
        """
        try:
            self._writer.finish()
            self._file.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file without its index; what has reached the disk stays readable."""
        with suppress(OSError):
            self._file.close()


def read(path: Path, on_damage: Callable[[str], None] = lambda _: None) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield the messages of a file in the order written: topic, type, time [ns], data.

    A truncated or damaged file is read as far as possible; a missing one, as of a flight aborted at its start, has no messages.
    Checksums are verified, as a decompressor accepts nearly all damaged data.

    Args:
        path: the file.
        on_damage: called with the reason if the file cannot be read to its end.
    """
    for schema, channel, message in _read(path, on_damage):
        yield channel.topic, schema.name if schema else "", message.log_time, message.data


def is_truncated(path: Path) -> bool:
    """Return whether a file lacks its end: the writer was killed, the disk was full, or the copy is incomplete.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        size = file.seek(0, SEEK_END)
        file.seek(max(0, size - len(MCAP0_MAGIC)))
        return file.read() != MCAP0_MAGIC


def recover(path: Path, copy: Path) -> str:
    """Copy the readable messages of a file to another one that has an index.

    Returns:
        Reason why the file could not be read to its end.

    Raises:
        OSError: the copy cannot be written.
    """
    damage: list[str] = []
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    with open(copy, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="perch")
        for schema, channel, message in _read(path, damage.append):
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schemas[channel.schema_id],
                                                               dict(channel.metadata))
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()
    return damage[0] if damage else "it has no end"


def _read(path: Path, on_damage: Callable[[str], None]) -> Iterator[tuple[mcap.records.Schema | None, mcap.records.Channel, mcap.records.Message]]:
    """Like `read`, but yields the library's records."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        try:
            yield from NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        except (McapError, EOFError, struct.error, ZstdError, CRCValidationError, UnicodeDecodeError, OverflowError, MemoryError) as error:
            on_damage(str(error) or type(error).__name__)
