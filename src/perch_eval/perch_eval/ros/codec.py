"""Messages and values, by channel, for components that take messages as they are on the wire."""

from __future__ import annotations

from functools import lru_cache

from perch_core.ros import topics
from perch_eval.ros.definitions import schema_of


class MessageCodec:
    """What `perch_core.ros.topics` knows, for components that import nothing of ROS.

    Attributes:
        schema: name and definition of a message class.
        message: message class of a channel.
        encode: a value of a channel as a serialised message.
        decode: the value of a channel's serialised message; PerchError: it cannot be a value.
    """

    schema = staticmethod(lru_cache(maxsize=None)(schema_of))
    message = staticmethod(topics.message_type)
    encode = staticmethod(topics.encode)
    decode = staticmethod(topics.decode)
