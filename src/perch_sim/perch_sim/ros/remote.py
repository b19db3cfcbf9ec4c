"""Proxies of participants in other processes, for the schedule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection

from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_sim.lockstep import Packet, Participant
from perch_sim.lockstep.link import NonBlockingSender, pack, receive, unpack

DISCONNECTED = "has disconnected"


class RemoteParticipant(Participant):
    """Sends batches over a connection, and receives results.

    Attributes:
        ended: why the connection has ended, for the log; empty: it has not.
    """

    def __init__(self, name: str, inputs: frozenset[str], connection: Connection, on_failure: Callable[[str, Exception], None]) -> None:
        """
        Args:
            name, inputs: see `Participant`.
            connection: to its process.
            on_failure: called with channel and exception for each value that has no message, which is not sent.
        """
        self.name, self.inputs, self.connection = name, inputs, connection
        self.ended = ""
        self._sender, self._on_failure = NonBlockingSender(connection), on_failure
        self._results: list[Packet] | None = None
        self._is_taken: Callable[[str], bool] = lambda channel: True

    def begin(self, now: int, batch: Sequence[Packet]) -> None:
        """Send a batch."""
        self._results = None
        try:
            self._sender.send(pack(now, batch, self._on_failure))
        except OSError:
            self.ended = DISCONNECTED

    def flush(self) -> None:
        """Send the rest of a batch to a process that did not read all of it."""
        if self._sender.finished:
            return
        try:
            self._sender.flush()
        except OSError:
            self.ended = DISCONNECTED

    def close(self) -> None:
        """Close the sending side of the connection."""
        self._sender.close()

    def receive(self) -> None:
        """Receive the results of a batch; set `ended` if the connection has ended, or if what it sends is no batch."""
        try:
            _, packets = unpack(receive(self.connection), topics)
        except BlockingIOError:
            self.ended = "is disconnected: it has stopped within a message"
        except (OSError, EOFError):
            self.ended = DISCONNECTED
        except PerchError as error:
            self.ended = f"is disconnected: {error}"
        else:
            self._results = [packet for packet in packets if self._is_taken(packet.channel)]

    def results(self) -> list[Packet] | None:
        """Return the results of the batch, once; None if they have not arrived."""
        results, self._results = self._results, None
        return results

    def set_channel_filter(self, is_taken: Callable[[str], bool]) -> None:
        """Set the check whether a channel has a receiver; received packets without one are dropped."""
        self._is_taken = is_taken
