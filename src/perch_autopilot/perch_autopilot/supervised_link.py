"""Link to the autopilot, owned by a separate process that continues when the commanding node is killed, hangs, or is restarted.

Betaflight before 2026.6 holds the last MSP command for ever. Commands therefore pass through this process, which sends frames at
a fixed rate from the first command on; without fresh commands the `Watchdog` determines their content. It ends when the node has
ended and the autopilot has received commands to stop the motors; if the link is lost then, it waits for it for a minute.

    node -> supervisor   b"C" armed, 4 channels: a command       b"R" bytes: a request for the autopilot       b"H" hover, descent: throttles
                         b"T": the motors turn already                       b"K": stop the motors
    supervisor -> node   b"D" bytes: from the autopilot          b"M" text: the watchdog's mode, or an error
"""

from __future__ import annotations

import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple
from pathlib import Path

from perch_autopilot import msp
from perch_autopilot.rate_curve import RateCurve
from perch_autopilot.watchdog import Mode, Watchdog
from perch_autopilot.link import REOPEN, Link, LinkError, PortTaken

RATE = 200.0        # of the frames to the autopilot [Hz]
COMMAND, THROTTLES = struct.Struct("<?4H"), struct.Struct("<2H")
_FINAL_FRAMES = 10  # with the motors off that the autopilot has received before it ends
_LINK_WAIT = 60.0   # for a lost link to come back, after the motors should have stopped [s]


class LinkSupervisor:
    """Sends the watchdog's channels at a fixed rate, and forwards bytes in both directions."""

    def __init__(self, address: str, control: socket.socket, watchdog: Watchdog,
                 clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            address: address of the link, see `Link`.
            control: socket to the node.
            watchdog: determines the content of the frames.
            clock: returns the time [s].

        Raises:
            LinkError: the link cannot be opened.
        """
        self._address, self._control, self._watchdog, self._period, self._clock = address, control, watchdog, 1.0 / RATE, clock
        self._link: Link | None = Link(address)
        self._opening: Link | None = None  # in place of one that has ended
        self._due = self._opened = self._stopped = clock()
        self._reported, self._node_gone, self._final_frames = Mode.DISARMED, False, 0
        self._parser = msp.Parser()

    def run(self) -> None:
        """Run until the node has ended and the motors are off."""
        while self._final_frames < _FINAL_FRAMES:
            self.work(max(0.0, self._due - self._clock()))

    def work(self, timeout: float) -> None:
        """Process packets and bytes that arrive within a time [s]; send a frame when it is due."""
        control = [] if self._node_gone else [self._control.fileno()]
        link = [] if self._link is None else [self._link.file]
        ready = select.select(control + link, [], [], timeout)[0]
        if ready and ready[0] in control:
            self._receive()
        if self._link is not None and self._link.file in ready:
            self._forward(self._link)
        now = self._clock()
        if now >= self._due:
            self._due = max(self._due + self._period, now - self._period)
            self._send_channels(now)

    def _send_channels(self, now: float) -> None:
        channels = self._watchdog.channels(now)
        if self._watchdog.mode is not self._reported:
            self._report_mode()
        done = not self._watchdog.command_received  # or the autopilot has received this frame, or is commanded by another process
        if self._link is None and now - self._opened > REOPEN:
            self._opened = now
            try:
                self._opening = self._opening or Link(self._address)
                if self._opening.connected():
                    self._link, self._opening = self._opening, None
                    self._report_mode()  # in place of the end of the link
            except PortTaken:
                done = True
            except LinkError:
                self._opening = None
        if self._watchdog.command_received:
            done |= self._send(msp.channels(channels) + (msp.request(msp.ATTITUDE) if self._watchdog.needs_attitude(now) else b""))
        if not (self._node_gone and self._reported is Mode.DISARMED):
            self._final_frames, self._stopped = 0, now
        elif done or now - self._stopped > _LINK_WAIT:
            self._final_frames += 1

    def _report_mode(self) -> None:
        self._reported = self._watchdog.mode
        self._notify(b"M" + self._reported.value.encode())

    def _send(self, data: bytes) -> bool:
        """Send a frame; return whether it has left as a whole."""
        try:
            return self._link is not None and self._link.write(data)
        except LinkError as error:
            self._close_link(error)
            return False

    def _close_link(self, error: LinkError) -> None:
        if self._link is not None:
            self._link.close()
        self._link, self._opened = None, self._clock()
        self._notify(b"M" + str(error).encode())

    def _receive(self) -> None:
        try:
            packet = self._control.recv(4096)
        except OSError:
            packet = b""
        if not packet:
            self._node_gone = True
        elif packet[:1] == b"C" and len(packet) == 1 + COMMAND.size:
            armed, *sticks = COMMAND.unpack_from(packet, 1)
            self._watchdog.command(self._clock(), armed, tuple(sticks))
        elif packet[:1] == b"R":
            self._send(packet[1:])
        elif packet[:1] == b"H" and len(packet) == 1 + THROTTLES.size:
            self._watchdog.set_throttles(*THROTTLES.unpack_from(packet, 1))
        elif packet == b"T":
            self._watchdog.report_motors_turning()
        elif packet == b"K":
            self._watchdog.kill()

    def _forward(self, link: Link) -> None:
        try:
            data = link.read()
        except LinkError as error:
            self._close_link(error)
            return
        self._notify(b"D" + data)
        for frame in self._parser.feed(data):
            if frame.command == msp.ATTITUDE and not frame.refused and len(frame.payload) >= 6:
                self._watchdog.attitude(self._clock(), *msp.attitude(frame)[:2])

    def _notify(self, packet: bytes) -> None:
        try:
            self._control.send(packet, socket.MSG_DONTWAIT)
        except OSError:
            pass  # the node has gone, or does not read: newer packets follow


class SupervisedLink:
    """The node's end of the supervised link."""

    def __init__(self, address: str, hover: int, descent: int, disarm_after: float, curves: Sequence[RateCurve]) -> None:
        """
        Args:
            address: see `Link`.
            hover, descent, disarm_after, curves: see `Watchdog`.

        Raises:
            LinkError: the link cannot be opened.
        """
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        passed = [theirs.fileno()] + ([int(address[3:])] if address.startswith("fd:") else [])
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        words = (theirs.fileno(), hover, descent, disarm_after, *(value for curve in curves for value in astuple(curve)))
        try:
            self.process = subprocess.Popen([sys.executable, "-m", "perch_autopilot.supervised_link", address, *map(str, words)],
                                            pass_fds=passed, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment,
                                            cwd=Path(__file__).parents[1], start_new_session=True)  # not interrupted by Ctrl-C
        except OSError as error:  # no memory, too many processes
            self._control.close()
            raise LinkError(f"{address}: the process that holds the link cannot be started: {error.strerror}") from None
        finally:
            theirs.close()
        self._control.settimeout(20.0)
        try:
            ready_message = self._control.recv(64)
        except OSError:
            ready_message = b""
        if ready_message != b"M":
            self._control.close()
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)  # for its message
            self.process.kill()
            output = self.process.communicate()[1].decode(errors="replace").strip().splitlines()
            raise LinkError(output[-1] if output else f"{address}: the process that holds the link does not start")
        if self.process.stderr is not None:
            self.process.stderr.close()
        self._control.setblocking(False)

    def command(self, armed: bool, sticks: tuple[int, int, int, int]) -> None:
        """Send a command, which is valid until it is stale."""
        self._send(b"C" + COMMAND.pack(armed, *sticks))

    def set_throttles(self, hover: int, descent: int) -> None:
        """Set the throttles of hover and descent [us]."""
        self._send(b"H" + THROTTLES.pack(hover, descent))

    def request(self, data: bytes) -> None:
        """Send bytes to the autopilot in addition to the commands."""
        self._send(b"R" + data)

    def report_motors_turning(self) -> None:
        """Report that the motors turn already, before the first command."""
        self._send(b"T")

    def kill(self) -> None:
        """Stop the motors until a command to disarm."""
        self._send(b"K")

    def _send(self, packet: bytes) -> None:
        with suppress(OSError):  # it is busy, or it has ended, which `receive` reports
            self._control.send(packet)

    def receive(self, timeout: float = 0.0) -> tuple[bytes, list[str]]:
        """Return the bytes from the autopilot and the messages of the supervisor that arrive within a time [s].

        Raises:
            LinkError: the process that holds the link has ended.
        """
        data, messages = b"", []
        while select.select([self._control], [], [], timeout)[0]:
            try:
                packet = self._control.recv(8192)
            except OSError:
                packet = b""
            if not packet:
                raise LinkError("the process that holds the link has ended")
            if packet[:1] == b"D":
                data += packet[1:]
            else:
                messages.append(packet[1:].decode(errors="replace"))
            timeout = 0.0
        return data, messages

    def close(self) -> None:
        """Stop commanding: the watchdog then levels, descends and stops the motors."""
        self._control.close()


def main() -> None:
    """Run the supervisor: address, file number, hover, descent, disarm_after; centre, maximum, expo of roll's and pitch's curve."""
    address, number, hover, descent, disarm_after, *rest = sys.argv[1:]
    roll, pitch = (RateCurve(*map(float, rest[k:k + 3])) for k in (0, 3))
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)
    control = socket.socket(fileno=int(number))
    try:
        supervisor = LinkSupervisor(address, control, Watchdog(int(hover), int(descent), float(disarm_after), curves=(roll, pitch)))
    except LinkError as error:
        sys.exit(str(error))
    control.send(b"M")
    supervisor.run()


if __name__ == "__main__":
    main()
