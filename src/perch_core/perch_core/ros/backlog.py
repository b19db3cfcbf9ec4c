"""Subscriptions that are emptied when it suits the node."""

from __future__ import annotations

from collections import deque

from rclpy.subscription import Subscription


class Backlog:
    """Messages of a topic, waiting in the middleware until they are taken.

    An executor wakes its node for every message. On a machine with two cores and ten nodes such a wake-up costs 50 to 100 us
    of processor time, most of it for caches that other nodes have filled; a message more at a wake-up costs 5.
    """

    def __init__(self, depth: int) -> None:
        self._subscription: Subscription | None = None
        self._messages: deque[bytes] = deque(maxlen=depth)  # of neighbours in the same process

    def keep(self, data: bytes) -> None:
        """Let a message wait here; at most `depth` do, older ones give way."""
        self._messages.append(data)

    def subscribe(self, subscription: Subscription) -> None:
        """Let messages wait in the middleware."""
        self._subscription = subscription

    def take(self) -> list[bytes]:
        """The serialised messages that have come since the last call, oldest first; at most as many as the topic's depth."""
        taken = list(self._messages)
        self._messages.clear()
        if self._subscription is None:
            return taken
        with self._subscription.handle:
            while (message := self._subscription.handle.take_message(self._subscription.msg_type, True)) is not None:
                taken.append(message[0])
        return taken
