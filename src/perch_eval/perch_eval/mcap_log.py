"""MCAP files with ROS 2 messages, as rosbag2 and Foxglove read them. (rosbag2_py is not among the PyPI wheels.)"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Callable, Iterator

from ament_index_python.packages import get_package_share_directory
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.stream_reader import CRCValidationError
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

_PRIMITIVE = {"bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32",
              "int64", "uint64", "string", "wstring"}


def type_name(msg_type: type) -> str:
    """`package/msg/Name` of a message class."""
    package, kind, *_ = msg_type.__module__.split(".")
    return f"{package}/{kind}/{msg_type.__name__}"


def message_definition(name: str) -> str:
    """Definition of a type followed by those of everything it contains, in MCAP's `ros2msg` form."""
    seen: dict[str, str] = {}

    def collect(full: str) -> None:
        package, kind, short = full.split("/")
        if full in seen:
            return
        seen[full] = (Path(get_package_share_directory(package)) / kind / f"{short}.msg").read_text()
        for line in seen[full].splitlines():
            word = line.split("#")[0].strip().split(" ")[0]
            base = word.split("[")[0].split("<")[0]
            if not base or base in _PRIMITIVE:
                continue
            inner_package, _, inner = base.rpartition("/")
            collect(f"{inner_package.split('/')[0] or package}/msg/{inner}")

    collect(name)
    first, *rest = seen
    parts = [seen[first]]
    for full in rest:
        package, _, short = full.split("/")
        parts += ["=" * 80, f"MSG: {package}/{short}", seen[full]]
    return "\n".join(parts)


class McapLog:
    """Writes serialised messages to a file that stays readable when the process is killed: chunks are flushed."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "wb")
        self._writer = Writer(self._file, compression=CompressionType.ZSTD, chunk_size=256 * 1024)
        self._writer.start(profile="ros2", library="perch")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add_topic(self, topic: str, name: str) -> None:
        """Declare a topic with its type, `package/msg/Name`."""
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(
                name=name, encoding="ros2msg", data=message_definition(name).encode())
        self._channels[topic] = self._writer.register_channel(
            topic=topic, message_encoding="cdr", schema_id=self._schemas[name])

    def write(self, topic: str, data: bytes, time: int) -> None:
        """Append one message; `time` is simulation time [ns]."""
        self._writer.add_message(self._channels[topic], log_time=time, publish_time=time, data=data)

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()
        self._file.close()


def read(path: Path, topics: set[str] | None = None,
         on_damage: Callable[[str], None] = lambda _: None) -> Iterator[tuple[str, str, int, bytes]]:
    """Messages of a file in the order written: topic, type, time [ns], data.

    A cut-off or damaged file is read as far as it goes; a flight that broke off before its first message has no file at all.
    Checksums are looked at: a decompressor makes something of nearly every damage.

    Args:
        path: the file.
        topics: only these.
        on_damage: told why a file could not be read to its end.
    """
    if not path.exists():
        return
    with open(path, "rb") as file:
        try:
            for schema, channel, message in NonSeekingReader(file, validate_crcs=True).iter_messages(
                    topics=list(topics) if topics else None, log_time_order=False):
                yield channel.topic, schema.name, message.log_time, message.data
        except (McapError, EOFError, struct.error, ZstdError, CRCValidationError, UnicodeDecodeError) as error:
            on_damage(str(error) or type(error).__name__)


def message_class(name: str) -> Any:
    """Message class of `package/msg/Name`."""
    package, kind, short = name.split("/")
    module = __import__(f"{package}.{kind}", fromlist=[short])
    return getattr(module, short)
