"""Betaflight's firmware in the loop: sensors and sticks in, motors out, one cycle per packet of the simulator.

    UDP 9003  state   18 doubles: time [s], angular velocity (FRD), specific force (-FLU), orientation wxyz, velocity, position, pressure
    UDP 9004  sticks  double, 16 uint16: time [s], pulse widths [us]
    UDP 9002  motors  4 floats 0..1: front right, rear left, front left, rear right
    TCP 5761  CLI and MSP
"""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from perch_core.arrays import Numbers
from perch_core.files import replacement
from perch_autopilot import firmware, msp
from perch_autopilot.configuration import Cli, Configuration
from perch_autopilot.firmware import FirmwareError
from perch_autopilot.namespace import IsolatedProgram

MOTORS, STATE, STICKS, SERIAL = 9002, 9003, 9004, 5761
CHANNELS = 16
_FROM_PACKET = (2, 1, 3, 0)       # front left, rear left, rear right, front right
_STATE, _STICKS, _MOTORS = struct.Struct("<18d"), struct.Struct("<d16H"), struct.Struct("<4f")
_START = 10.0                     # for the firmware to open its port [s]
_ANSWER = 5.0                     # for motors after a state, on a busy machine [s]
_FOLDER = "perch-betaflight-"     # in which it finds its memory; removed when it has read it
_ORPHAN = 600.0                   # age of a folder whose owner was killed before that [s]
CYCLE = 0.002                     # between states that are sent [s]
_EEPROM = "eeprom.bin"
LEVEL = (1.0, 0.0, 0.0, 0.0)      # w x y z
GRAVITY = (0.0, 0.0, 9.81)


class FirmwareTimeoutError(FirmwareError):
    """Raised when the firmware runs but does not answer."""


class Sitl:
    """A running firmware with its configuration.

    Attributes:
        time: time of the last packet [s].
    """

    def __init__(self, configuration: Configuration) -> None:
        """
        Args:
            configuration: sent and read back unless this firmware had it before.

        Raises:
            FirmwareError: the firmware is not installed, or does not answer.
            NamespaceError: no network namespace is available.
            CliError: the configuration is refused, or differs from what is read back.
        """
        self._program, self._configuration = firmware.find_program(), configuration
        self._running: IsolatedProgram | None = None
        self.time = 0.0
        remove_orphans()
        try:
            with tempfile.TemporaryDirectory(prefix=_FOLDER) as folder:
                memory = Path(folder, _EEPROM)
                shutil.copyfile(self._configured(memory), memory)
                self._launch(memory)
                self.step((0.0, 0.0, 0.0), GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
        except BaseException:
            self.close()
            raise

    # -- start -------------------------------------------------------------------------------------------------------

    def _configured(self, draft: Path) -> Path:
        """Return the memory file that holds the configuration; it is made once, by a firmware whose memory file is `draft`."""
        memory = self._program.parent / f"{self._configuration.identity}.eeprom"
        if not memory.exists():
            self._launch(draft)
            Cli(self.send, self.receive).apply(self._configuration)
            try:
                self._firmware.process.wait(_START)  # saving restarts it, which here is its end
            except subprocess.TimeoutExpired:
                raise FirmwareTimeoutError(f"Betaflight's firmware does not save its settings within {_START:g} s") from None
            self._launch(draft)
            Cli(self.send, self.receive).check(self._configuration)
            self.close()
            with replacement(memory) as copy:
                shutil.copyfile(draft, copy)
        return memory

    def _launch(self, memory: Path) -> None:
        self.close()
        self._running = running = IsolatedProgram([self._program], memory.parent, MOTORS)
        running.received.settimeout(_ANSWER)
        last = time.monotonic() + _START
        while True:
            try:
                running.stream.connect(("127.0.0.1", SERIAL))
                return
            except ConnectionRefusedError:
                if running.process.poll() is not None:
                    raise FirmwareError(f"Betaflight's firmware ended at its start, code {running.process.returncode}") from None
                if time.monotonic() > last:
                    raise FirmwareTimeoutError(f"Betaflight's firmware does not open its port {SERIAL} within {_START:g} s") from None
                time.sleep(0.01)

    # -- cycles ------------------------------------------------------------------------------------------------------

    def step(self, gyro: Numbers, force: Numbers, q_wxyz: Numbers, channels: Sequence[int]) -> tuple[float, ...]:
        """Run one cycle of the firmware.

        Args:
            gyro: angular velocity in FLU [rad/s].
            force: specific force in FLU [m/s^2].
            q_wxyz: orientation of B (FLU) in W (z up), used by self-levelling modes only; sent turned about x, like the rates.
            channels: pulse widths [us]; the rest of the 16 are set low.

        Returns:
            Motors 0..1: front left, rear left, rear right, front right.

        Raises:
            FirmwareTimeoutError: the firmware does not answer.
        """
        self.time += CYCLE
        running = self._firmware
        p, q, r = gyro
        x, y, z = force
        w, i, j, k = q_wxyz
        sticks = _STICKS.pack(self.time, *channels, *(1000,) * (CHANNELS - len(channels)))
        running.sent.sendto(sticks, ("127.0.0.1", STICKS))
        state = _STATE.pack(self.time, p, -q, -r, -x, -y, -z, w, i, -j, -k, 0, 0, 0, 0, 0, 0, 101325.0)
        running.sent.sendto(state, ("127.0.0.1", STATE))
        try:
            motors = _MOTORS.unpack_from(running.received.recv(64))
        except TimeoutError:
            raise FirmwareTimeoutError(f"Betaflight's firmware has not answered for {_ANSWER:g} s at {self.time:.3f} s") from None
        return tuple(min(max(motors[n], 0.0), 1.0) for n in _FROM_PACKET)

    @property
    def _firmware(self) -> IsolatedProgram:
        if self._running is None:
            raise FirmwareError("Betaflight's firmware has been ended")
        return self._running

    # -- CLI and MSP -------------------------------------------------------------------------------------------------

    def send(self, data: bytes) -> None:
        """Send bytes to the firmware's serial port.

        Raises:
            FirmwareError: the firmware has ended, or does not read.
        """
        self._firmware.stream.settimeout(_ANSWER)
        try:
            self._firmware.stream.sendall(data)
        except OSError as error:
            raise FirmwareError(f"Betaflight's firmware cannot be sent anything: {error.strerror or error}") from None

    def receive(self, timeout: float) -> bytes:
        """Return the bytes that arrive from the firmware's serial port within a time [s].

        Raises:
            FirmwareError: the firmware has ended.
        """
        self._firmware.stream.settimeout(timeout)
        try:
            if data := self._firmware.stream.recv(4096):
                return data
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError:
            pass
        raise FirmwareError("Betaflight's firmware has ended: it has closed its serial port")

    @property
    def file(self) -> int:
        """File number of the firmware's serial port, for another user of MSP."""
        return self._firmware.stream.fileno()

    def status(self) -> msp.Status:
        """Request the firmware's status over MSP."""
        parser, last = msp.Parser(), time.monotonic() + _ANSWER
        self.send(msp.request(msp.STATUS))
        while time.monotonic() < last:
            for frame in parser.feed(self.receive(0.1)):
                return msp.status(frame)
        raise FirmwareTimeoutError("Betaflight's firmware does not answer MSP")

    def close(self) -> None:
        """End the firmware."""
        if self._running is not None:
            self._running.close()
            self._running = None


def remove_orphans() -> None:
    """Remove folders of processes that were killed before the firmware had read its memory."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*"):
        with suppress(OSError):  # another process has removed it
            if time.time() - folder.stat().st_mtime > _ORPHAN:
                shutil.rmtree(folder, ignore_errors=True)
