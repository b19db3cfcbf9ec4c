"""MultiWii serial protocol, version 1, as Betaflight implements it: frames, and the few messages that a companion computer needs.

    '$' 'M' direction  size  command  payload  checksum        direction: '<' request, '>' answer, '!' refused
                       u8    u8       size     xor of size, command and payload

Numbers are little-endian. `RAW_IMU` is in FLU; angles of `ATTITUDE` are positive to the right, nose down, clockwise from north.
"""

from __future__ import annotations

import struct
from functools import reduce
from math import radians
from operator import xor
from typing import NamedTuple

from perch_core.errors import PerchError

FC_VARIANT, FC_VERSION, ANALOG, RAW_IMU, ATTITUDE, STATUS, SET_RAW_RC = 2, 3, 110, 102, 108, 150, 200
GYRO_LSB = 16.4  # readings per deg/s: the firmware's gyros have a range of 2000 deg/s
VERSIONS = ((4, 3), (4, 6))
"""Oldest and newest supported firmware; later versions invert the sign of yaw."""
ARMING_REASONS = (
    "no gyro: check the sensor and the firmware's target", "failsafe: switch the radio on, and the arming switch off",
    "no radio signal (RX_FAILSAFE): switch the radio on, check the receiver", "not recovered from failsafe: switch the arming switch off",
    "box failsafe switch: switch it off", "runaway take-off: check the order of motors and propellers, and the board's orientation",
    "crash detected: switch the arming switch off", "throttle is not low: pull it down",
    "tilted beyond small_angle: stand it level, or set small_angle = 180", "starting up (BOOT_GRACE_TIME): wait",
    "no pre-arm: switch it on", "processor overload: raise pid_process_denom, or switch features off",
    "calibrating: keep the vehicle still", "CLI is open: leave it (exit), which restarts the autopilot", "CMS menu is open: leave it",
    "BST: its other end blocks arming", "MSP connection blocks arming (configurator): close it",
    "paralyzed: restart the autopilot", "GPS rescue has no fix: wait for it, or allow arming without", "GPS rescue is switched on: switch it off",
    "RPM filter without telemetry: check the speed controllers and dshot_bidir", "reboot required: restart the autopilot",
    "DSHOT bitbang: set dshot_bitbang, or other pins", "accelerometer is not calibrated: calibrate it",
    "motor protocol is not set: set motor_pwm_protocol", "crash flip is switched on: switch it off",
    "altitude hold is switched on: switch it off", "position hold is switched on: switch it off")
"""Reasons for which the firmware refuses to arm, with remedies, by bit of its flags. Their number depends on the version;
the last one is always `TOO_EARLY`."""
LASTING = (0, 13, 17, 21, 22, 23, 24)
"""Bits of the reasons that need a repair, a setting or a restart: waiting does not clear them."""
TOO_EARLY = "arming switch was on too early: switch it off first"


class MspError(PerchError):
    """Raised for invalid or refused MSP messages, and for autopilots that do not answer, are not supported or cannot fly."""


class Frame(NamedTuple):
    """An answer of the firmware.

    Attributes:
        command: number of the command that is answered.
        payload: bytes of the payload.
        refused: whether the firmware rejects the command.
    """

    command: int
    payload: bytes
    refused: bool


def request(command: int, payload: bytes = b"") -> bytes:
    """Return a request as bytes; the payload has up to 255 bytes."""
    body = bytes((len(payload), command)) + payload
    return b"$M<" + body + bytes((reduce(xor, body),))


class Parser:
    """Finds answers in a stream of bytes that arrives in pieces of any size.

    Attributes:
        checksum_errors: number of frames with a wrong checksum.
        skipped: number of bytes that belong to no frame.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.checksum_errors = self.skipped = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that `data` completes. Bytes outside frames are skipped; of a corrupt frame, the first byte."""
        self._bytes += data
        buffer = self._bytes
        found: list[Frame] = []
        while True:
            start = buffer.find(b"$M")
            if start < 0:
                keep = 1 if buffer.endswith(b"$") else 0
                self.skipped += len(buffer) - keep
                del buffer[:len(buffer) - keep]
                return found
            self.skipped += start
            del buffer[:start]
            if len(buffer) < 5:
                return found
            size = buffer[3]
            if buffer[2] not in b">!":
                self._skip()
            elif len(buffer) < size + 6:
                return found
            elif reduce(xor, buffer[3:size + 5]) != buffer[size + 5]:
                self.checksum_errors += 1
                self._skip()
            else:
                found.append(Frame(buffer[4], bytes(buffer[5:size + 5]), buffer[2] == ord("!")))
                del buffer[:size + 6]

    def _skip(self) -> None:
        self.skipped += 1
        del self._bytes[:1]


def _unpacked(layout: str, frame: Frame) -> tuple:
    """Unpack the beginning of a frame's payload; later firmware appends fields to it."""
    size = struct.calcsize(layout)
    if frame.refused or len(frame.payload) < size:
        raise MspError(f"MSP {frame.command}: " + ("refused" if frame.refused else f"{len(frame.payload)} bytes, needs {size}"))
    return struct.unpack_from(layout, frame.payload)


class Version(NamedTuple):
    """Variant and version number of a firmware."""

    variant: str
    number: tuple[int, int, int]

    def __str__(self) -> str:
        return f"{self.variant} {'.'.join(map(str, self.number))}"


def version(variant: Frame, number: Frame) -> Version:
    """Return the version in the answers to `FC_VARIANT` and `FC_VERSION`.

    Raises:
        MspError: the firmware is not Betaflight, or its version is outside `VERSIONS`; or an answer is refused or too short.
    """
    found = Version(_unpacked("<4s", variant)[0].decode("ascii", "replace"), _unpacked("<3B", number))
    low, high = VERSIONS
    if found.variant != "BTFL" or not low <= found.number[:2] <= high:
        raise MspError(f"the autopilot runs {found}, not Betaflight (BTFL) {low[0]}.{low[1]} to {high[0]}.{high[1]}")
    return found


class Status(NamedTuple):
    """Status of the flight controller.

    Attributes:
        modes: active flight modes, one bit each, in the order of the firmware's boxes; bit 0 is ARM.
        refusals: reasons that prevent arming; empty if there are none.
        lasting: those of them that clear neither by themselves nor by the pilot's switches.
    """

    modes: int
    refusals: tuple[str, ...]
    lasting: tuple[str, ...]

    @property
    def armed(self) -> bool:
        """Whether the vehicle is armed."""
        return bool(self.modes & 1)


def status(frame: Frame) -> Status:
    """Return the status in an answer to `STATUS` (MSP_STATUS_EX).

    Raises:
        MspError: the answer is refused or too short.
    """
    modes, _, _, _, _, more = _unpacked("<6xIBHBBB", frame)
    at = 16 + (more & 0x0F)
    if len(frame.payload) < at + 5:
        raise MspError(f"MSP {frame.command}: {len(frame.payload)} bytes, needs {at + 5}")
    count, flags = struct.unpack_from("<BI", frame.payload, at)
    words = (*ARMING_REASONS[:count - 1], TOO_EARLY)
    found = {bit: words[bit] if bit < len(words) else f"flag {bit}" for bit in range(32) if flags >> bit & 1}
    return Status(modes, tuple(found.values()), tuple(found[bit] for bit in LASTING if bit in found))


class Battery(NamedTuple):
    """Voltage [V], strength of the radio's signal 0..1, current [A]."""

    voltage: float
    rssi: float
    current: float


def battery(frame: Frame) -> Battery:
    """Return the battery in an answer to `ANALOG`.

    Raises:
        MspError: the answer is refused or too short.
    """
    tenths, rssi, current = _unpacked("<B2xHh", frame)
    voltage = _unpacked("<7xH", frame)[0] / 100.0 if len(frame.payload) >= 9 else tenths / 10.0
    return Battery(voltage, min(rssi / 1023.0, 1.0), current / 100.0)


def attitude(frame: Frame) -> tuple[float, float, float]:
    """Return roll, pitch, heading in an answer to `ATTITUDE` [rad], FRD in NED: roll to the right, nose up, clockwise from north.

    Raises:
        MspError: the answer is refused or too short.
    """
    roll, pitch, heading = _unpacked("<3h", frame)
    return radians(roll / 10.0), radians(-pitch / 10.0), radians(heading)


def inertial(frame: Frame, one_g: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return specific force [m/s^2] and angular velocity [rad/s] in an answer to `RAW_IMU`, both in FLU.

    Args:
        frame: the answer.
        one_g: reading of the accelerometer at rest (2048 with the usual sensors, 512 before 4.6, 256 in the simulated one).

    Raises:
        MspError: the answer is refused or too short.
    """
    *force, p, q, r = _unpacked("<6h", frame)
    x, y, z = (9.81 * value / one_g for value in force)
    return (x, y, z), (radians(p / GYRO_LSB), radians(q / GYRO_LSB), radians(r / GYRO_LSB))


def channels(values: tuple[int, ...]) -> bytes:
    """Return the request `SET_RAW_RC` with pulse widths [us]."""
    return request(SET_RAW_RC, struct.pack(f"<{len(values)}H", *values))
