"""Link to an autopilot: a serial port or TCP, held by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import select
import socket
import termios
import threading
from contextlib import suppress
from typing import Any

from perch_core.errors import PerchError

CONNECT_TIMEOUT = 3.0  # of the first connection to an address [s]
REOPEN = 0.2           # from one attempt to open a link that has ended to the next [s]

_SYN_RETRIES = 1       # of a later connection, which then fails after 3 s at most
_peers: dict[str, tuple[int, Any]] = {}  # address -> family and socket address to which it was connected
_resolving: set[str] = set()  # addresses whose host is being looked up, which may take seconds
_TAKEN = "another process has this port: another node, or the link supervisor of a node that has ended"


class LinkError(PerchError):
    """Raised when the link cannot be opened, or has ended."""


class PortTaken(LinkError):
    """Raised when another process has the port."""


class Link:
    """Stream of bytes to and from an autopilot.

    Once an address has been connected by TCP, further links to it wait neither for a name server nor for the autopilot: until they
    are connected, nothing is read, and what is written is dropped. The name is resolved again meanwhile, for the next attempt.
    """

    def __init__(self, address: str) -> None:
        """
        Args:
            address: `/dev/ttyACM0`, `/dev/ttyACM0@921600` (115200 baud without a rate), `tcp:HOST:PORT`, or `fd:NUMBER`, a file
                that this process has open.

        Raises:
            LinkError: the link cannot be opened.
        """
        self._rest = b""  # of a frame that the port has accepted in part
        self._sockets: tuple[socket.socket, ...] = ()
        try:
            if found := re.fullmatch(r"tcp:([^:]+):(\d+)", address):
                self._sockets = _connected(address, found[1], int(found[2]))
                self.file = self._sockets[0].fileno()
            elif found := re.fullmatch(r"fd:(\d+)", address):
                self.file = int(found[1])
            else:
                self.file = _opened_port(address)
            os.set_blocking(self.file, False)
        except LinkError:
            raise
        except (OSError, OverflowError, ValueError) as error:  # ValueError: a name that no host or file can have
            raise LinkError(f"{address}: cannot be opened: {getattr(error, 'strerror', None) or error}") from None

    def write(self, data: bytes) -> bool:
        """Send a frame, whole or not at all: while the port is full it is dropped, because a late command would be worse.

        Returns:
            Whether the port has accepted the whole frame.

        Raises:
            LinkError: the link has ended.
        """
        try:
            if self._rest:
                self._rest = self._rest[os.write(self.file, self._rest):]
            if not self._rest:
                self._rest = data[os.write(self.file, data):]
                return not self._rest
        except BlockingIOError:
            pass
        except OSError as error:
            raise LinkError(f"the link to the autopilot has ended: {error.strerror}") from None
        return False

    def read(self, timeout: float = 0.0) -> bytes:
        """Return the bytes that arrive within a time [s]; empty if there are none.

        Raises:
            LinkError: the link has ended.
        """
        if not select.select([self.file], [], [], timeout)[0]:
            return b""
        try:
            data = os.read(self.file, 4096)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LinkError(f"the link to the autopilot has ended: {error.strerror}") from None
        if not data:
            raise LinkError("the link to the autopilot has ended")
        return data

    def connected(self) -> bool:
        """Return whether the link carries bytes.

        Raises:
            LinkError: the connection has failed.
        """
        if not self._sockets:
            return True
        if error := self._sockets[0].getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self.close()
            raise LinkError(f"the autopilot cannot be connected: {os.strerror(error)}")
        return bool(select.select([], [self.file], [], 0.0)[1])

    def close(self) -> None:
        """Close the link."""
        for one in self._sockets:
            one.close()
        if not self._sockets:
            os.close(self.file)


def _connected(address: str, host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Return the connection, which may have begun only, and the lock of its address: an abstract socket name, which one process of this machine can hold.

    Raises:
        OSError, OverflowError, LinkError: the connection is refused, or another process holds the lock.
    """
    lock = socket.socket(socket.AF_UNIX)
    try:
        lock.bind(f"\0perch_autopilot {address}")
    except OSError as error:
        lock.close()
        if error.errno != errno.EADDRINUSE:  # its name is too long
            raise
        raise PortTaken(f"{address}: {_TAKEN}") from None
    try:
        if address in _peers:
            if address not in _resolving:
                _resolving.add(address)
                try:
                    threading.Thread(target=_resolve, args=(address, host, port), daemon=True).start()
                except RuntimeError:  # no thread can be made now: the address stays as it is
                    _resolving.discard(address)
            connection = _connecting(*_peers[address])
        else:
            connection = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT)
            _peers[address] = connection.family, connection.getpeername()
    except BaseException:
        lock.close()
        raise
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection, lock


def _resolve(address: str, host: str, port: int) -> None:
    """Look up where a host is now; its present address is kept if the name still has it, or if no name server answers."""
    with suppress(OSError):
        found = [(family, peer) for family, _, _, _, peer in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
        if _peers[address] not in found:
            _peers[address] = next((one for one in found if one[0] == _peers[address][0]), found[0])
    _resolving.discard(address)


def _connecting(family: int, peer: Any) -> socket.socket:
    """Begin a connection and return its socket.

    Raises:
        OSError: it is refused at once.
    """
    connection = socket.socket(family, socket.SOCK_STREAM)
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_SYNCNT, _SYN_RETRIES)
    error = connection.connect_ex(peer)
    if error not in (0, errno.EINPROGRESS):
        connection.close()
        raise OSError(error, os.strerror(error))
    return connection


def _opened_port(address: str) -> int:
    """Open, lock and configure a serial port; return its file number.

    Raises:
        OSError, LinkError: the port cannot be opened, or another process holds it.
    """
    device, _, baud = address.partition("@")
    file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _set_serial(file, baud or "115200", address)
    except BlockingIOError:
        os.close(file)
        raise PortTaken(f"{address}: {_TAKEN}") from None
    except BaseException:
        os.close(file)
        raise
    return file


def _set_serial(file: int, baud: str, address: str) -> None:
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise LinkError(f"{address}: {baud} is not a baud rate of a serial port")
    plain = termios.CS8 | termios.CREAD | termios.CLOCAL  # no flow control, one stop bit, whatever its last user has set
    try:
        characters = termios.tcgetattr(file)[6]
        characters[termios.VMIN], characters[termios.VTIME] = 1, 0
        termios.tcsetattr(file, termios.TCSANOW, [0, 0, plain, 0, speed, speed, characters])
    except termios.error as error:
        raise LinkError(f"{address}: is not a serial port: {error.args[-1]}") from None
