"""Proxy in front of a WebSocket server that accepts every web page: it admits only pages of allowed origins.

Browsers let any page open a WebSocket to this machine and send the page's origin to the server; other programs send none. As
Foxglove's server does not check the origin, any page that a user visits could read the flight. The server therefore listens at a
random address of the loopback network (127.0.0.0/8) and a random port, 39 bits that no page can guess in time, and this proxy at
the public address.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket
import threading
from collections.abc import Iterable
from urllib.parse import urlsplit

from perch_core.errors import ConfigError

HEADER_MAX = 16384  # of a handshake [bytes]
HANDSHAKE_TIME = 5.0  # [s]
CHUNK = 65536
REFUSAL = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


def unservable(host: str, port: int, error: OSError) -> ConfigError:
    """Return the error for an address that cannot be served: in use, not permitted, or not one of this machine."""
    return ConfigError("viewer", "port", f"{host}:{port} cannot be served ({error.strerror}); choose another, as in --view 8766")


def check_free(host: str, port: int) -> None:
    """Check that a port can be served, before anything is started.

    Raises:
        ConfigError: it cannot be served.
    """
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise unservable(host, port, error) from None


def hidden_host() -> str:
    """A random address of this machine's loopback network."""
    return "127." + ".".join(str(1 + secrets.randbelow(254)) for _ in range(3))


def allowed(origin: str | None, origins: Iterable[str]) -> bool:
    """Return whether a page of an origin may connect.

    Args:
        origin: as in the handshake, `scheme://host[:port]`; None: not a browser.
        origins: allowed ones; without a port, every port of the host; `*`: all.
    """
    if origin is None:
        return True
    for one in origins:
        if one in ("*", origin) and origin != "null":
            return True
        if "://" in one and _parts(one) == (*_parts(origin)[:2], None):
            return True
    return False


def _parts(origin: str) -> tuple[str, str | None, int | None]:
    """Return scheme, host and port of an origin; a malformed one has a port that is none."""
    with contextlib.suppress(ValueError):
        parts = urlsplit(origin)
        return parts.scheme.lower(), parts.hostname, parts.port
    return "", origin, -1


class Gate:
    """Listens at an address and forwards connections of allowed origins."""

    def __init__(self, host: str, port: int, backend: tuple[str, int], origins: Iterable[str]) -> None:
        """
        Args:
            host, port: address that is served; port 0: any free one.
            backend: address of the server backend.
            origins: allowed ones, see `allowed`.

        Raises:
            OSError: the address cannot be served.
        """
        self._backend, self._origins = backend, tuple(origins)
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._handle_connection, host, port, limit=HEADER_MAX))
        except BaseException:
            self._loop.close()
            raise
        self._thread = threading.Thread(target=self._loop.run_forever, name="viewer gate", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that is served."""
        return self._server.sockets[0].getsockname()[1]

    def close(self) -> None:
        """Stop accepting connections, and end those that the server behind has not ended."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(timeout=5.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5.0)
        if not self._thread.is_alive():
            self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        _, late = await asyncio.wait(tasks, timeout=0.5) if tasks else (None, ())
        for task in late:
            task.cancel()
        await asyncio.gather(*late, return_exceptions=True)

    async def _handle_connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner: asyncio.StreamWriter | None = None
        try:
            header = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HANDSHAKE_TIME)
            if not allowed(_origin(header), self._origins):
                writer.write(REFUSAL)
                await writer.drain()
                return
            from_inner, inner = await asyncio.open_connection(*self._backend)
            inner.write(header)
            await asyncio.gather(_forward(reader, inner), _forward(from_inner, writer))
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, asyncio.CancelledError):
            pass  # no handshake, or the end of a connection
        finally:
            for end in filter(None, (writer, inner)):
                end.close()


def _origin(header: bytes) -> str | None:
    """Return the origin in a handshake; of several, `null`, which is never allowed."""
    found = [value.strip().decode("latin-1") for name, _, value in (line.partition(b":") for line in header.split(b"\r\n")[1:])
             if name.strip().lower() == b"origin"]
    return (found[0] if len(found) == 1 else "null") if found else None


async def _forward(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Forward the bytes of one direction until its end, as fast as they are accepted."""
    while data := await reader.read(CHUNK):
        writer.write(data)
        await writer.drain()
    if writer.can_write_eof():
        with contextlib.suppress(OSError):
            writer.write_eof()
