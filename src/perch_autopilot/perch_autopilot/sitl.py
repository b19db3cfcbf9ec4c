"""Betaflight's firmware in the loop: sensors and sticks in, motors out, one cycle per packet of the simulator.

    UDP 9003  state   18 doubles: time [s], angular velocity (FRD), specific force (-FLU), orientation wxyz, velocity, position, pressure
    UDP 9004  sticks  double, 16 uint16: time [s], pulse widths [us]
    UDP 9002  motors  4 floats 0..1: front right, rear left, front left, rear right
    TCP 5761  CLI and MSP
"""

from __future__ import annotations

import select
import shutil
import struct
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from perch_core.timing import CONTROL_PERIOD
from perch_autopilot import firmware, msp
from perch_autopilot.configuration import Cli, CliError, CliSilent, Configuration
from perch_autopilot.firmware import FirmwareError
from perch_autopilot.namespace import IsolatedProgram

MOTORS, STATE, STICKS, SERIAL = 9002, 9003, 9004, 5761
CHANNELS = 16
_FROM_PACKET = (2, 1, 3, 0)       # front left, rear left, rear right, front right
_STATE, _STICKS, _MOTORS = struct.Struct("<18d"), struct.Struct("<d16H"), struct.Struct("<4f")
_START = 10.0                     # for the firmware to open its port [s]
_ANSWER = 1.0                     # for motors after a state; a busy machine takes its time [s]
_TRIES = 5                        # packets that stay unanswered before the firmware counts as frozen
STARTS = 4                        # of one that freezes
_EEPROM = "eeprom.bin"
LEVEL = (1.0, 0.0, 0.0, 0.0)      # w x y z
GRAVITY = (0.0, 0.0, 9.81)


class Frozen(FirmwareError):
    """The firmware runs but does not answer: it has to be started again."""


class Sitl:
    """A running firmware with its configuration.

    Attributes:
        time: of the last packet [s].
        starts: how often it was started until it answered.
    """

    def __init__(self, configuration: Configuration) -> None:
        """
        Args:
            configuration: sent and read back where this firmware has not had it before.

        Raises:
            FirmwareError: it is not there, or does not answer.
            NamespaceError: no network namespace.
            CliError: the configuration is refused, or not what is read back.
        """
        self._program, self._configuration = firmware.found(), configuration
        self._folder = tempfile.TemporaryDirectory(prefix="perch-betaflight-")
        self._running: IsolatedProgram | None = None
        self.time, self.starts = 0.0, 0
        self._late = False
        try:
            shutil.copy2(self._configured(), Path(self._folder.name, _EEPROM))
            self._start()
        except BaseException:
            self.close()
            raise

    # -- start -------------------------------------------------------------------------------------------------------

    def _configured(self) -> Path:
        """The firmware's memory with the configuration in it, made once."""
        memory = self._program.parent / f"{self._configuration.identity}.eeprom"
        if not memory.exists():
            self._command_line().apply(self._configuration)
            self._running.process.wait(_START)  # saving restarts it, which here is its end
            self._command_line().check(self._configuration)
            self._stop()
            draft = memory.with_suffix(f".{id(self)}")
            shutil.copy2(Path(self._folder.name, _EEPROM), draft)
            draft.replace(memory)
        return memory

    def _command_line(self) -> Cli:
        """Of a firmware that has just been started, again where it freezes."""
        for _ in range(STARTS - 1):
            self._launch()
            with suppress(CliSilent):
                return Cli(self.send, self.receive)
        self._launch()
        return Cli(self.send, self.receive)

    def _launch(self) -> None:
        self._stop()
        self._running = IsolatedProgram([self._program], Path(self._folder.name), MOTORS)
        self._running.received.settimeout(_ANSWER)
        last = time.monotonic() + _START
        while True:
            try:
                self._running.stream.connect(("127.0.0.1", SERIAL))
                return
            except ConnectionRefusedError:
                if self._running.process.poll() is not None:
                    raise FirmwareError(f"Betaflight's firmware ended at its start, code {self._running.process.returncode}") from None
                if time.monotonic() > last:
                    raise Frozen(f"Betaflight's firmware does not open its port {SERIAL} within {_START:g} s") from None
                time.sleep(0.01)

    def _start(self) -> None:
        while True:
            self.starts += 1
            try:
                self._launch()
                self.time = 0.0
                self.step((0.0, 0.0, 0.0), GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
                return
            except Frozen:
                if self.starts >= STARTS:
                    raise

    # -- cycles ------------------------------------------------------------------------------------------------------

    def step(self, gyro: Sequence[float], force: Sequence[float], q_wxyz: Sequence[float], channels: Sequence[int]) -> tuple[float, ...]:
        """One cycle of the firmware.

        Args:
            gyro: angular velocity in FLU [rad/s].
            force: specific force in FLU [m/s^2].
            q_wxyz: orientation of B (FLU) in W (z up), which only self-levelling modes look at; sent turned about x, as the rates.
            channels: pulse widths [us]; the rest of 16 are low.

        Returns:
            Motors 0..1: front left, rear left, rear right, front right.

        Raises:
            Frozen: no answer.
        """
        self.time += CONTROL_PERIOD
        running = self._running
        p, q, r = gyro
        x, y, z = force
        w, i, j, k = q_wxyz
        if self._late:  # a packet that was repeated may have been answered twice
            self._late = bool(select.select([running.received], [], [], 0.01)[0] and running.received.recv(64))
        sticks = _STICKS.pack(self.time, *channels, *(1000,) * (CHANNELS - len(channels)))
        for attempt in range(_TRIES):
            stamp = self.time + attempt * 1e-5
            running.sent.sendto(sticks, ("127.0.0.1", STICKS))
            running.sent.sendto(_STATE.pack(stamp, p, -q, -r, -x, -y, -z, w, i, -j, -k, 0, 0, 0, 0, 0, 0, 101325.0), ("127.0.0.1", STATE))
            try:
                motors = _MOTORS.unpack_from(running.received.recv(64))
            except TimeoutError:
                continue
            self._late = self._late or attempt > 0
            return tuple(min(max(motors[n], 0.0), 1.0) for n in _FROM_PACKET)
        raise Frozen(f"Betaflight's firmware has not answered {_TRIES} packets at {self.time:.3f} s")

    # -- CLI and MSP -------------------------------------------------------------------------------------------------

    def send(self, data: bytes) -> None:
        """Bytes to its serial port."""
        self._running.stream.settimeout(_ANSWER)
        self._running.stream.sendall(data)

    def receive(self, timeout: float) -> bytes:
        """Bytes that have come from its serial port within a time [s]."""
        self._running.stream.settimeout(timeout)
        try:
            return self._running.stream.recv(4096)
        except TimeoutError:
            return b""

    @property
    def file(self) -> int:
        """File number of its serial port, for another that speaks MSP."""
        return self._running.stream.fileno()

    def status(self) -> msp.Status:
        """Of the firmware, as MSP tells it."""
        parser, last = msp.Parser(), time.monotonic() + _ANSWER
        self.send(msp.request(msp.STATUS))
        while time.monotonic() < last:
            for frame in parser.feed(self.receive(0.1)):
                return msp.status(frame)
        raise Frozen("Betaflight's firmware does not answer MSP")

    def _stop(self) -> None:
        if self._running is not None:
            self._running.close()
            self._running = None

    def close(self) -> None:
        """End it."""
        self._stop()
        self._folder.cleanup()


__all__ = ["CliError", "Frozen", "Sitl"]
