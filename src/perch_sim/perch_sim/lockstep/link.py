"""Transport of batches and results between the vehicle's process and a participant's, over a local socket; without ROS.

A step takes four transfers in sequence. Over DDS each takes 150 us and more; over a Unix socket 20 to 40 us, and the end of a
process ends its connection at once. Only processes of the same user are accepted.
"""

from __future__ import annotations

import errno
import json
import os
import select
import socket
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Client, Connection

from perch_core.errors import PerchError
from perch_sim.lockstep.packet import Codec, Packet

_BATCH, _PACKET = struct.Struct("<qI"), struct.Struct("<HI")  # stamp [ns] and number of packets; lengths of channel and data [byte]
_PEER = struct.Struct("3i")                                   # process, user, group
_SEND_LIMIT = struct.pack("ll", 0, 20_000)                    # longest wait for a participant that does not read [s, us]
_RECEIVE_LIMIT = struct.pack("ll", 10, 0)                     # ... and for the rest of a message that has begun [s, us]
_SEND_BUFFER = 1 << 20                                       # holds an image, so that the vehicle does not wait for its reader [B]
_LENGTH = struct.Struct("!i")                                 # of a message, as in multiprocessing
_READ = 1 << 13                                               # holds the batch of a fast participant [B]
_READ_MAX = 1 << 20                                           # asked for at a time, whatever length a message states [B]


def address(domain: str, namespace: str) -> str:
    """Return the address of the vehicle of a ROS domain and namespace, in Linux's abstract namespace, which leaves no file."""
    return f"\0perch-lockstep-{os.getuid()}-{domain}-{namespace.strip('/')}"


def pack(stamp: int, packets: Sequence[Packet], on_failure: Callable[[str, Exception], None] | None = None) -> bytes:
    """Return a batch, or its results, as bytes.

    Args:
        stamp: of the batch [ns].
        packets: in order.
        on_failure: called with channel and exception for each value that has no message, which is left out; None: it is raised.
    """
    parts: list[bytes] = []
    for packet in packets:
        try:
            channel, data = packet.channel.encode(), packet.data
        except Exception as error:
            if on_failure is None:
                raise
            on_failure(packet.channel, error)
        else:
            parts += (_PACKET.pack(len(channel), len(data)), channel, data)
    return b"".join((_BATCH.pack(stamp, len(parts) // 3), *parts))


def unpack(data: bytes, codec: Codec) -> tuple[int, list[Packet]]:
    """Return stamp [ns] and packets from bytes that `pack` made.

    Raises:
        PerchError: the bytes are not a valid batch.
    """
    try:
        (stamp, count), offset = _BATCH.unpack_from(data), _BATCH.size
        packets = []
        for _ in range(count):
            name, length = _PACKET.unpack_from(data, offset)
            offset += _PACKET.size
            if offset + name + length > len(data):
                raise PerchError(f"lockstep: {len(data)} bytes are not a batch: they end within a packet")
            channel, offset = data[offset:offset + name].decode(), offset + name
            packets.append(Packet.received(channel, data[offset:offset + length], codec))
            offset += length
    except (struct.error, UnicodeDecodeError) as error:
        raise PerchError(f"lockstep: {len(data)} bytes are not a batch: {error}") from None
    return stamp, packets


def claimed(where: str) -> socket.socket:
    """Return a socket at the address of a vehicle: while it is open, there is no other vehicle. Nobody can connect before it listens.

    Raises:
        PerchError: another vehicle has this address.
    """
    claim = socket.socket(socket.AF_UNIX)
    try:
        claim.bind(where)
    except OSError as error:
        claim.close()
        if error.errno == errno.EADDRINUSE:
            raise PerchError("another vehicle runs in this ROS domain and namespace") from None
        raise PerchError(f"vehicle: cannot have the address {where[1:]!r}: {error}") from None
    return claim


class ParticipantListener:
    """The vehicle's listening socket, which accepts participants."""

    def __init__(self, where: str) -> None:
        """
        Raises:
            PerchError: another vehicle has this address.
        """
        self._socket = claimed(where)
        self._socket.setblocking(False)
        self._socket.listen(16)

    def accept(self) -> list[tuple[str, frozenset[str], Connection]]:
        """Return the participants that have connected since the last call: name, input channels and connection."""
        accepted: list[tuple[str, frozenset[str], Connection]] = []
        while True:
            try:
                peer, _ = self._socket.accept()
            except OSError:
                return accepted
            user = _PEER.unpack(peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))[1]
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _SEND_LIMIT)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _RECEIVE_LIMIT)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)  # as far as net.core.wmem_max permits
            connection = Connection(peer.detach())
            try:
                if user != os.getuid() or not connection.poll(1.0):
                    raise OSError("not the same user, or silent")
                greeting = json.loads(connection.recv_bytes(1 << 16))
                accepted.append((str(greeting["node"]), frozenset(map(str, greeting["inputs"])), connection))
            except (OSError, EOFError, ValueError, KeyError, TypeError, RecursionError):
                connection.close()

    def close(self) -> None:
        """Stop accepting participants."""
        self._socket.close()


class NonBlockingSender:
    """Sends messages over a connection without waiting for a process that hangs; the rest is sent when it reads again."""

    def __init__(self, connection: Connection) -> None:
        self._socket = socket.socket(fileno=os.dup(connection.fileno()))
        self._unsent = memoryview(b"")

    @property
    def finished(self) -> bool:
        """Whether the last message has been sent completely."""
        return not self._unsent

    def send(self, data: bytes) -> None:
        """Send a message, with at most `_SEND_LIMIT` of waiting for the reader; the previous one must have been read.

        Raises:
            OSError: the other end has closed the connection.
        """
        self._unsent = memoryview(_LENGTH.pack(len(data)) + data)
        self.flush(0)

    def flush(self, flags: int = socket.MSG_DONTWAIT) -> None:
        """Send as much of the rest as possible.

        Raises:
            OSError: the other end has closed the connection.
        """
        try:
            while self._unsent:
                self._unsent = self._unsent[self._socket.send(self._unsent, flags):]
        except BlockingIOError:
            pass

    def close(self) -> None:
        """Close the sending socket."""
        self._socket.close()


def connect_to_vehicle(where: str, name: str, inputs: frozenset[str]) -> Connection | None:
    """Connect a participant to the vehicle; return None if there is no vehicle."""
    with suppress(OSError):
        connection = Client(where, "AF_UNIX")
        connection.send_bytes(json.dumps({"node": name, "inputs": sorted(inputs)}).encode())
        return connection
    return None


def receive(connection: Connection) -> bytes:
    """Return the next message of a connection whose other end waits for the answer, so that no other message follows it.

    `Connection.recv_bytes` reads length and content by one call of the operating system each, this function by one for both.

    Raises:
        EOFError: the connection has ended.
        OSError: it is broken, or the rest of a message does not come.
        PerchError: what it sends is not one message.
    """
    data = _read(connection, _READ)
    while len(data) < _LENGTH.size:
        data += _read(connection, _READ)
    parts, left = [data[_LENGTH.size:]], _LENGTH.size + _LENGTH.unpack_from(data)[0] - len(data)
    while left > 0:
        parts.append(_read(connection, min(left, _READ_MAX)))
        left -= len(parts[-1])
    if left < 0:
        raise PerchError("lockstep: more than one message at a time")
    return b"".join(parts)


def _read(connection: Connection, size: int) -> bytes:
    data = os.read(connection.fileno(), size)
    if not data:
        raise EOFError
    return data


class ConnectionPoll:
    """Waits for data on several connections. `Connection.poll` creates a selector for each call, which takes 0.1 ms."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._connections: dict[int, Connection] = {}

    def add(self, connection: Connection) -> None:
        """Add a connection."""
        self._connections[connection.fileno()] = connection
        self._poll.register(connection.fileno(), select.POLLIN)

    def remove(self, connection: Connection) -> None:
        """Remove a connection, and close it."""
        if not connection.closed:
            self._poll.unregister(connection.fileno())
            del self._connections[connection.fileno()]
            connection.close()

    def ready(self, timeout: float) -> list[Connection]:
        """Return the connections that can be read or have ended; wait for the first up to `timeout` [s]."""
        return [self._connections[number] for number, _ in self._poll.poll(1e3 * timeout)]
