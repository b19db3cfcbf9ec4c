"""Messages of fixed layout on the wire, without rclpy's objects.

rclpy makes a Python object of every field: an `Odometry` costs its reader 380 us and its writer 40, at 500 Hz more than all that is
done with it. `Layout` reads and writes the numbers and texts of such messages directly; the layout comes from the message's own
definition. The format is OMG CDR (XCDR1, little endian), which every ROS 2 middleware uses: 4 bytes of encapsulation, then
the fields in order, each aligned to its size, counted from the end of the encapsulation.
"""

from __future__ import annotations

import importlib
import struct
from collections.abc import Iterator, Sequence

import numpy as np
from perch_core.errors import PerchError
from rosidl_parser.definition import AbstractString, Array, BasicType, NamespacedType

_HEADER = 4
_LITTLE_ENDIAN = b"\0\1\0\0"
_LENGTH = struct.Struct("<I")
_TEXT = "s"
_CODES = {"boolean": "?", "octet": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "uint64": "Q",
          "int64": "q", "float": "f", "double": "d"}


class Layout:
    """Layout of one message type: runs of numbers of one kind, and texts.

    Attributes:
        runs: (kind, count) in order: kind as in `struct`, or "s" for a text; neighbouring numbers of a kind are one run.
    """

    def __init__(self, message: type) -> None:
        """
        Args:
            message: of numbers, texts, arrays of fixed length and messages of these.

        Raises:
            TypeError: it has fields of variable length that are no texts.
        """
        self.runs: list[tuple[str, int]] = []
        for kind, count in _fields(message):
            if self.runs and kind != _TEXT and self.runs[-1][0] == kind:
                self.runs[-1] = kind, self.runs[-1][1] + count
            else:
                self.runs.append((kind, count))
        self._name = message.__name__
        self._plan = [(kind, count, struct.Struct(f"<{count}{kind}"), struct.calcsize(kind)) for kind, count in self.runs]

    def unpack(self, data: bytes) -> list:
        """The content of a serialised message: for each run a text, a tuple of numbers, or an array where these are floats.

        Raises:
            PerchError: it is cut short, big endian or no message of this type.
        """
        if data[:2] != b"\0\1":
            raise PerchError(f"{self._name}: not in little-endian CDR")
        found, offset = [], _HEADER
        try:
            for kind, count, form, size in self._plan:
                if kind == _TEXT:
                    offset += -offset % 4
                    length = _LENGTH.unpack_from(data, offset)[0]
                    offset += 4 + length
                    found.append(data[offset - length:offset - 1].decode())
                    continue
                offset += (_HEADER - offset) % size
                if kind == "d":
                    found.append(np.frombuffer(data, "<f8", count, offset))
                else:
                    found.append(form.unpack_from(data, offset))
                offset += form.size
        except (struct.error, ValueError) as error:
            raise PerchError(f"{self._name}: {len(data)} bytes are no such message: {error}") from None
        return found

    def pack(self, *content: str | bytes | Sequence) -> bytes:
        """A serialised message.

        Args:
            content: for each run a text, the numbers, or their bytes.
        """
        parts, offset = [_LITTLE_ENDIAN], 0
        for (kind, _, form, size), value in zip(self._plan, content, strict=True):
            if kind == _TEXT:
                text = value.encode() + b"\0"
                pad = -offset % 4
                parts += (b"\0" * pad, _LENGTH.pack(len(text)), text)
                offset += pad + 4 + len(text)
                continue
            pad = -offset % size
            if pad:
                parts.append(b"\0" * pad)
            parts.append(value if isinstance(value, bytes) else form.pack(*value))
            offset += pad + form.size
        return b"".join(parts)


def _fields(message: type) -> Iterator[tuple[str, int]]:
    for slot in message.SLOT_TYPES:
        yield from _kinds(slot)


def _kinds(slot: object) -> Iterator[tuple[str, int]]:
    if isinstance(slot, BasicType):
        yield _CODES[slot.typename], 1
    elif isinstance(slot, AbstractString):
        yield _TEXT, 1
    elif isinstance(slot, Array):
        for kind, count in _kinds(slot.value_type):
            yield kind, count * slot.size
    elif isinstance(slot, NamespacedType):
        yield from _fields(getattr(importlib.import_module(".".join(slot.namespaces)), slot.name))
    else:
        raise TypeError(f"{slot!r} has no fixed length")
