"""Starts a program in a network namespace of its own, and communicates with it through sockets opened in that namespace.

The firmware's ports are fixed and bound to all interfaces. In namespaces of their own, which have only a loopback device, any
number of instances run side by side, and no other process can reach them. A socket stays in the namespace in which it was opened:
the new process opens the sockets for its parent, passes them over, and then becomes the program. Nothing is relayed.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from perch_core.errors import PerchError

_TIMEOUT = 20.0  # for a process to start on a busy machine [s]
_INSIDE = """
import ctypes, fcntl, os, signal, socket, struct, sys
parent, port, program = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]), sys.argv[3:]
ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)   # PR_SET_PDEATHSIG: ends with its parent
ctypes.CDLL(None).prctl(29, 1, 0, 0, 0)               # PR_SET_TIMERSLACK: short sleeps stay short
received, sent, stream = (socket.socket(socket.AF_INET, kind) for kind in (socket.SOCK_DGRAM, socket.SOCK_DGRAM, socket.SOCK_STREAM))
fcntl.ioctl(sent, 0x8914, struct.pack("16sh", b"lo", 0x41))  # SIOCSIFFLAGS: up, running
received.bind(("127.0.0.1", port))
socket.send_fds(parent, [b"ok"], [received.fileno(), sent.fileno(), stream.fileno()])
os.dup2(1, 2)  # nobody reads on
os.execv(program[0], program)
"""


class NamespaceError(PerchError):
    """Raised when the operating system provides no network namespace."""


class IsolatedProgram:
    """A program in its own network namespace.

    Attributes:
        process: the program.
        received: UDP socket bound to the requested port, on the namespace's loopback device.
        sent: UDP socket to send from.
        stream: TCP socket, not connected yet.
    """

    def __init__(self, program: Sequence[str | Path], folder: Path, port: int) -> None:
        """
        Args:
            program: absolute path and arguments.
            folder: working directory of the program.
            port: UDP port of `received`.

        Raises:
            NamespaceError: no namespace is available.
        """
        unshare = shutil.which("unshare")
        if unshare is None:
            raise NamespaceError("Betaflight runs in a network namespace of its own, which needs the program 'unshare' (apt: util-linux)")
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.process = subprocess.Popen(
                [unshare, "--user", "--map-root-user", "--net", sys.executable, "-I", "-S", "-c", _INSIDE, str(theirs.fileno()), str(port),
                 *map(str, program)],
                cwd=folder, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                start_new_session=True)  # not interrupted by Ctrl-C
            theirs.close()
            ours.settimeout(_TIMEOUT)
            try:
                word, handed, _, _ = socket.recv_fds(ours, 2, 3)
            except TimeoutError:
                word, handed = b"", []
            if word != b"ok":
                self.process.kill()
                reason = self.process.communicate()[1].decode(errors="replace").strip().splitlines()
                raise NamespaceError(f"no network namespace for Betaflight: {reason[-1] if reason else 'no answer'}")
        finally:
            ours.close()
            theirs.close()
        if self.process.stderr is not None:
            self.process.stderr.close()
        self.received, self.sent, self.stream = (socket.socket(fileno=number) for number in handed)

    def close(self) -> None:
        """End the program."""
        for one in (self.received, self.sent, self.stream):
            one.close()
        self.process.kill()
        self.process.wait()

