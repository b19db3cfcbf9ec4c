"""Betaflight's firmware as a simulated vehicle's autopilot, spoken to as on a vehicle: the node's commands go to a supervisor, and from it
over MSP to the firmware, whose receiver hears the pilot's radio. All of it in simulated time, so that the same flight is the same again."""

from __future__ import annotations

import socket
import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from closed_loop.plant import Plant
from perch_autopilot import msp
from perch_autopilot.supervised_link import COMMAND, LinkSupervisor
from perch_autopilot.loop import FirmwareLoop
from perch_autopilot.watchdog import DESCENT, OFF, ON, Watchdog
from perch_core import so3
from perch_core.values import NANOSECONDS
from perch_core.vehicle import Vehicle
from perch_sim.timing import CONTROL_PERIOD_NS

_PATIENCE = 20.0  # for the firmware's answer to a frame [s]


class LateWatchdog(Watchdog):
    """Its attitude comes late, as over a serial line from tasks of 100 Hz and 1 kHz."""

    delay = 0.01  # [s]

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self._coming: list[tuple[float, float, float]] = []

    def attitude(self, now, roll, pitch):
        self._coming.append((now, roll, pitch))

    def channels(self, now):
        while self._coming and self._coming[0][0] <= now - self.delay + 1e-6:
            super().attitude(now, *self._coming.pop(0)[1:])
        return super().channels(now)


class SupervisedLoop(FirmwareLoop):
    """Of a node that can be cut off, and be killed, and of a pilot.

    Attributes:
        radio: the pilot's channels [us]: sticks, arming, level, hand-over to the companion computer.
        cut: commands do not reach the supervisor.
        severed: nothing reaches the firmware's serial port.
        last_command: time of the last command that has reached it [s].
        aimed: what the motors aim at, (4,) [rad/s].
    """

    def __init__(self, vehicle: Vehicle) -> None:
        super().__init__(vehicle)
        self.severed = False
        self.radio, self.cut, self.last_command = [1500, 1500, 1000, 1500, OFF, OFF, ON], False, 0.0
        self.watchdog = LateWatchdog(self.sticks.throttle_for(1.0), self.sticks.throttle_for(DESCENT), curves=self.sticks.curves[:2])
        self._node, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._node.setblocking(False)
        self._time, self._parser = 0.0, msp.Parser()
        self._supervisor = LinkSupervisor(f"fd:{self.sitl.file}", theirs, self.watchdog, lambda: self._time)
        link = self._supervisor._link
        self._link_read, link.read = link.read, self._read
        self._answers: set[int] = set()
        self._killed = False
        self.aimed = np.zeros(4)

    def command(self, now, armed, rates, thrust):
        if not (self.cut or self._killed or self.severed):
            self.last_command = now / NANOSECONDS
            self._node.send(b"C" + COMMAND.pack(armed, *self.sticks.channels(rates, thrust)))

    def kill(self) -> None:
        """End the node."""
        self._killed = True
        self._node.close()

    def speeds(self, now, x, speeds, sample):
        self.aimed = super().speeds(now, x, speeds, sample)
        return self.aimed

    def channels(self, now):
        self._time = now
        if self.severed:
            return tuple(self.radio)
        if now >= self._supervisor._due:  # a frame counts from the cycle on that follows its answer
            self._answers.clear()
            self._supervisor.work(0.0)
            if self.watchdog.command_received:
                self._answered({msp.SET_RAW_RC, msp.ATTITUDE} if self.watchdog.needs_attitude(now) else {msp.SET_RAW_RC})
        else:
            self._supervisor.work(0.0)
        return tuple(self.radio)

    def _read(self, timeout: float = 0.0) -> bytes:
        data = self._link_read(timeout)
        self._answers |= {frame.command for frame in self._parser.feed(data)}
        return data

    def _answered(self, wanted: set[int]) -> None:
        last = time.monotonic() + _PATIENCE
        while not wanted <= self._answers:
            assert time.monotonic() < last, "the firmware does not answer the supervisor"
            self._supervisor.work(1.0)
            with suppress(OSError):  # killed, or nothing more has come
                while self._node.recv(8192):
                    pass

    def close(self) -> None:
        self._node.close()
        super().close()


@dataclass
class Felt:
    """What an IMU reads, see `FirmwareLoop.speeds`."""

    gyro: np.ndarray
    accel: np.ndarray


class Body:
    """A free body with rotors behind a `SupervisedLoop`, 500 m up.

    Attributes:
        loop: its autopilot.
        plant: the body.
        time: [s].
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.loop, self.plant = SupervisedLoop(vehicle), Plant(vehicle, p=np.array([0.0, 0.0, 500.0]))
        self._step, self._force = 0, np.array([0.0, 0.0, 9.81])

    @property
    def time(self):
        return self._step * CONTROL_PERIOD_NS / NANOSECONDS

    @property
    def tilt(self) -> float:
        """[deg]."""
        return float(np.degrees(np.arccos(np.clip(self.plant.R[2, 2], -1.0, 1.0))))

    def step(self, armed: bool, rates=(0.0, 0.0, 0.0), moving: bool = True) -> None:
        """A period with a command, thrust that of a hover; on a bench where the body is not `moving`."""
        now = self._step * CONTROL_PERIOD_NS
        self.loop.command(now, armed, rates, 9.81)
        x = np.r_[np.zeros(3), so3.quat_from_matrix(self.plant.R), np.zeros(6)]
        speeds = self.loop.speeds(now, x, np.zeros(4), Felt(self.plant.w, self._force))
        if moving:
            self.plant.advance(speeds)
            self._force = self.plant.specific_force_B
        self._step += 1

    def hover(self) -> None:
        """Armed, and settled: half a second."""
        for k in range(500):
            self.step(k >= 50, moving=k >= 250)

    def found(self, axis, tilt: float, rate: float) -> None:
        """Tilted about an axis by an angle [deg], turning at a rate [rad/s] as it is told to, for 50 ms."""
        self.plant.R, self.plant.w = so3.exp(np.radians(tilt) * np.array(axis)), rate * np.array(axis)
        for _ in range(25):
            self.step(True, tuple(rate * np.array(axis)))
