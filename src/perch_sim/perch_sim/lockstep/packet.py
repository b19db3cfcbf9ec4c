"""Packets of the schedule: a value on a channel, as a value or as a serialised message, each created when it is first read."""

from __future__ import annotations

from typing import Any, Protocol


class Codec(Protocol):
    """Converts values to serialised messages and back."""

    def encode(self, channel: str, value: Any) -> bytes:
        """Return the serialised message of a value."""

    def decode(self, channel: str, data: bytes) -> Any:
        """Return the value of a serialised message."""


class Packet:
    """One emitted value.

    Attributes:
        channel: relative name of the topic.
        value: value for components; decoded from `data` when it is first read.
        data: serialised message; encoded from `value` when it is first read.
    """

    __slots__ = ("channel", "value", "data", "_codec")

    channel: str
    value: Any
    data: bytes

    def __init__(self, channel: str, value: Any, codec: Codec | None = None) -> None:
        """
        Args:
            channel: relative name of the topic.
            value: value for components.
            codec: encodes `data`; None: `data` is never read.
        """
        self.channel, self.value, self._codec = channel, value, codec

    @classmethod
    def received(cls, channel: str, data: bytes, codec: Codec | None = None) -> Packet:
        """Return the packet of a serialised message."""
        packet = cls.__new__(cls)
        packet.channel, packet.data, packet._codec = channel, data, codec
        return packet

    def __getattr__(self, name: str) -> Any:
        """Create the missing form, value or data; attributes that are set are read without this call."""
        if name not in ("value", "data"):
            raise AttributeError(name)
        if self._codec is None:
            raise TypeError(f"{self.channel}: a packet without a codec has no {name}")
        if name == "value":
            self.value = self._codec.decode(self.channel, self.data)
            return self.value
        self.data = self._codec.encode(self.channel, self.value)
        return self.data

    def __repr__(self) -> str:
        return f"Packet({self.channel!r})"
