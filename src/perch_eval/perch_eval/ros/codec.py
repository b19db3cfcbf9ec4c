"""Messages and values, by channel, for components that take messages as they are on the wire."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from perch_core.ros import topics
from perch_eval.ros.definitions import schema_of


class MessageCodec:
    """What `perch_core.ros.topics` knows, behind `perch_eval.messages_in.Codec`."""

    schema = staticmethod(lru_cache(maxsize=None)(schema_of))

    def message(self, channel: str) -> type:
        """Message class of a channel."""
        return topics.message_type(channel)

    def encode(self, channel: str, value: Any) -> bytes:
        """A value as a serialised message."""
        return topics.encode(channel, value)

    def decode(self, channel: str, data: bytes) -> Any:
        """The value of a serialised message.

        Raises:
            PerchError: the message cannot be a value.
        """
        return topics.decode(channel, data)
