"""A process of its own that holds the wire: it goes on where the node that commands is killed, hangs, or is restarted.

Betaflight before 2026.6 holds the last MSP command for ever. So commands go through this process, which says something at a fixed
rate whatever happens, and what it says when nobody commands any more is the `Watchdog`'s. It ends when nobody commands and the
motors are off.

    node -> keeper   b"C" armed, 4 channels: a command       b"R" bytes: a request for the autopilot       b"H" hover, descent: throttles
    keeper -> node   b"D" bytes: from the autopilot          b"M" text: what the watchdog does now
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from perch_autopilot import msp
from perch_autopilot.watchdog import Mode, Watchdog, WatchdogSettings
from perch_autopilot.wire import Wire, WireError

COMMAND, THROTTLES = struct.Struct("<?4H"), struct.Struct("<2H")
_REOPEN = 0.2   # from one attempt to open a wire that has ended to the next [s]
_FAREWELL = 10  # frames with the motors off before it ends


class Keeper:
    """What the process does."""

    def __init__(self, address: str, control: socket.socket, watchdog: Watchdog, rate: float,
                 clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            address: of the wire, see `Wire`.
            control: to the node.
            watchdog: what is said.
            rate: of the frames [Hz].
            clock: [s].

        Raises:
            WireError: the wire cannot be opened.
        """
        self._address, self._control, self._watchdog, self._period, self._clock = address, control, watchdog, 1.0 / rate, clock
        self._wire: Wire | None = Wire(address)
        self._due = self._opened = clock()
        self._said, self._alone, self._farewell = Mode.DISARMED, False, 0

    def run(self) -> None:
        """Until nobody commands and the motors are off."""
        while self._farewell < _FAREWELL:
            self.work(max(0.0, self._due - self._clock()))

    def work(self, timeout: float) -> None:
        """Take a word that has come, or comes within a time [s]; speak where it is due."""
        sources = [one for one in (None if self._alone else self._control, self._wire and self._wire.file) if one is not None]
        ready = select.select(sources, [], [], timeout)[0]
        if self._control in ready:
            self._hear()
        if self._wire is not None and self._wire.file in ready:
            self._pass_on()
        now = self._clock()
        if now >= self._due:
            self._due = max(self._due + self._period, now - self._period)
            self._speak(now)

    def _speak(self, now: float) -> None:
        channels = self._watchdog.channels(now)
        if self._watchdog.mode is not self._said:
            self._said = self._watchdog.mode
            self._tell(b"M" + self._said.value.encode())
        self._farewell = self._farewell + 1 if self._alone and self._said is Mode.DISARMED else 0
        if self._wire is None and now - self._opened > _REOPEN:
            self._opened = now
            try:
                self._wire = Wire(self._address)
            except WireError:
                return
        self._send(msp.channels(channels))

    def _send(self, data: bytes) -> None:
        try:
            if self._wire is not None:
                self._wire.write(data)
        except WireError as error:
            self._lost(error)

    def _lost(self, error: WireError) -> None:
        self._wire.close()
        self._wire, self._opened = None, self._clock()
        self._tell(b"M" + str(error).encode())

    def _hear(self) -> None:
        try:
            word = self._control.recv(4096)
        except OSError:
            word = b""
        if not word:
            self._alone = True
        elif word[:1] == b"C" and len(word) == 1 + COMMAND.size:
            armed, *sticks = COMMAND.unpack_from(word, 1)
            self._watchdog.command(self._clock(), armed, tuple(sticks))
        elif word[:1] == b"R":
            self._send(word[1:])
        elif word[:1] == b"H" and len(word) == 1 + THROTTLES.size:
            self._watchdog.carrying(*THROTTLES.unpack_from(word, 1))

    def _pass_on(self) -> None:
        try:
            self._tell(b"D" + self._wire.read())
        except WireError as error:
            self._lost(error)

    def _tell(self, word: bytes) -> None:
        try:
            self._control.send(word, socket.MSG_DONTWAIT)
        except OSError:
            pass  # the node is gone, or does not listen: it learns of the present later


class KeeperLink:
    """The node's end."""

    def __init__(self, address: str, settings: WatchdogSettings, hover: int, descent: int) -> None:
        """
        Args:
            address: see `Wire`.
            settings, hover, descent: see `Watchdog`.

        Raises:
            WireError: the wire cannot be opened.
        """
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        passed = [theirs.fileno()] + ([int(address[3:])] if address.startswith("fd:") else [])
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        self.process = subprocess.Popen([sys.executable, "-m", "perch_autopilot.keeper", address, str(theirs.fileno()),
                                         json.dumps(asdict(settings)), str(hover), str(descent)],
                                        pass_fds=passed, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment,
                                        cwd=Path(__file__).parents[1], start_new_session=True)  # a Ctrl-C is not for it
        theirs.close()
        self._control.settimeout(20.0)
        try:
            begun = self._control.recv(64)
        except OSError:
            begun = b""
        if begun != b"M":
            self._control.close()
            words = self.process.communicate(timeout=5.0)[1].decode(errors="replace").strip().splitlines()
            raise WireError(words[-1] if words else f"{address}: the process that holds the wire does not start")
        self.process.stderr.close()
        self._control.setblocking(False)

    def command(self, armed: bool, sticks: tuple[int, int, int, int]) -> None:
        """What the autopilot shall do, until a command is stale."""
        self._send(b"C" + COMMAND.pack(armed, *sticks))

    def carrying(self, hover: int, descent: int) -> None:
        """Throttles of hover and descent [us] from now on."""
        self._send(b"H" + THROTTLES.pack(hover, descent))

    def request(self, data: bytes) -> None:
        """Bytes for the autopilot beside the commands."""
        self._send(b"R" + data)

    def _send(self, word: bytes) -> None:
        try:
            self._control.send(word)
        except BlockingIOError:
            pass
        except OSError:
            raise WireError("the process that holds the wire has ended") from None

    def receive(self, timeout: float = 0.0) -> tuple[bytes, list[str]]:
        """What has come from the autopilot, and what the watchdog has said, within a time [s].

        Raises:
            WireError: the process that holds the wire has ended.
        """
        data, said = b"", []
        while select.select([self._control], [], [], timeout)[0]:
            word = self._control.recv(8192)
            if not word:
                raise WireError("the process that holds the wire has ended")
            if word[:1] == b"D":
                data += word[1:]
            else:
                said.append(word[1:].decode(errors="replace"))
            timeout = 0.0
        return data, said

    def close(self) -> None:
        """Stop commanding: motors off where they turn, by the watchdog's times."""
        self._control.close()


def main() -> None:
    """The process: address, file number, settings, hover, descent."""
    address, number, words, hover, descent = sys.argv[1:]
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    settings = WatchdogSettings(**json.loads(words))
    control = socket.socket(fileno=int(number))
    try:
        keeper = Keeper(address, control, Watchdog(settings, int(hover), int(descent)), settings.rate)
    except WireError as error:
        sys.exit(str(error))
    control.send(b"M")
    keeper.run()


if __name__ == "__main__":
    main()
