"""Whether an address can be served, asked before anything is started."""

from __future__ import annotations

import socket

from perch_core.errors import ConfigError

ADVICE = "choose another, as in --view 8766"


def check_free(host: str, port: int) -> None:
    """Make sure that a port can be served.

    Raises:
        ConfigError: it is in use, may not be used, or the address is none of this machine's.
    """
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise ConfigError("viewer", "port", f"{host}:{port} cannot be served ({error.strerror}); {ADVICE}") from None
