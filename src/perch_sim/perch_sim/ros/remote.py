"""Proxies of participants in other processes, for the schedule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection

from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_sim.lockstep import Packet, Participant
from perch_sim.lockstep.link import Sending, pack, unpack


class RemoteParticipant(Participant):
    """Sends batches over a connection, and receives results.

    Attributes:
        gone: whether the process has ended or has closed the connection.
    """

    def __init__(self, name: str, inputs: frozenset[str], connection: Connection) -> None:
        self.name, self.inputs, self.connection = name, inputs, connection
        self.gone = False
        self._sending = Sending(connection)
        self._results: list[Packet] | None = None
        self._taken: Callable[[str], bool] = lambda channel: True

    def begin(self, now: int, batch: Sequence[Packet]) -> None:
        """Send a batch."""
        self._results = None
        try:
            self._sending.send(pack(now, batch))
        except OSError:
            self.gone = True

    def go_on(self) -> None:
        """Send the rest of a batch to a process that did not read all of it."""
        try:
            self._sending.go_on()
        except OSError:
            self.gone = True

    def close(self) -> None:
        """Close the sending side of the connection."""
        self._sending.close()

    def receive(self) -> None:
        """Receive the results of a batch; set `gone` if the connection has ended."""
        try:
            _, packets = unpack(self.connection.recv_bytes(), topics)
        except (OSError, EOFError, PerchError):
            self.gone = True
        else:
            self._results = [packet for packet in packets if self._taken(packet.channel)]

    def results(self) -> list[Packet] | None:
        """Return the results of the batch, once; None if they have not arrived."""
        results, self._results = self._results, None
        return results

    def listen(self, taken: Callable[[str], bool]) -> None:
        """Set the check whether a channel has a receiver; received packets without one are dropped."""
        self._taken = taken
