"""Component of the node `mavlink`: commands an autopilot with MAVLink 2 (PX4, ArduPilot) by body rates and thrust.

| to it | SET_ATTITUDE_TARGET (body rates, thrust), ODOMETRY with covariance, HEARTBEAT, TIMESYNC, COMMAND_LONG (mode, arm, IMU rate), PARAM_REQUEST_READ |
| --- | --- |
| from it | HEARTBEAT, HIGHRES_IMU, TIMESYNC, COMMAND_ACK, STATUSTEXT, PARAM_VALUE (GUID_OPTIONS and ATC_ANGLE_BOOST of ArduPilot) |

If commands stop, set points stop, and the autopilot's own failsafe for their loss takes effect. The messages are those of
`pymavlink`, an optional extra (`python3 scripts/setup.py --extra mavlink`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from math import isfinite, nan
from typing import Any

import numpy as np

from perch_core.component import Component, Diagnostics, Input, LogLine, Output, Timer
from perch_core.config import quantity, text
from perch_core.errors import PerchError
from perch_core.values import NANOSECONDS, Command, ControllerCommand, ImuSample, OdometryState, RatesThrust, RotorState, seconds
from perch_autopilot import frames
from perch_autopilot.arming import Stop
from perch_autopilot.clock import MAX_STEP, ClockOffset, clock_jump
from perch_autopilot.offboard import ANGLE_BOOST, ARDUPILOT, GUID_OPTIONS, HEARTBEAT_TIMEOUT, PX4, THRUST_AS_THRUST, Offboard, Request
from perch_autopilot.link import REOPEN, Link, LinkError
from perch_autopilot.rates import commanded_vehicle

_HANDSHAKE = 3.0                     # for the autopilot's first heartbeat, which come once a second [s]
_JUMP_SAMPLES = 3                    # samples in a row that do not follow the last one: its clock has jumped
_POLL = 0.005                        # [s]
_HELD = 100_000_000                  # rates and thrust that are older are not sent any more [ns]
_HELD_POLLS = round(_HELD / (_POLL * NANOSECONDS))  # ... or after so many polls: the host's clock may stand still (use_sim_time)
_RESULTS = ("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS", "CANCELLED")  # MAV_RESULT
_SET_MODE, _ARM_DISARM, _SET_INTERVAL = 176, 400, 511  # MAV_CMD_DO_SET_MODE, MAV_CMD_COMPONENT_ARM_DISARM, MAV_CMD_SET_MESSAGE_INTERVAL
_HIGHRES_IMU, _IMU_RATE = 105, 200   # its message id; rate that is requested: autopilots send it at 50 Hz or not at all by default [Hz]
_COMPONENT = 191                     # ours: MAV_COMP_ID_ONBOARD_COMPUTER
_FORCED = 21196.0                    # of MAV_CMD_COMPONENT_ARM_DISARM: disarm also in flight
_LOCAL_FRD, _BODY_FRD = 20, 12       # MAV_FRAME: axes as NED, whose x need not be north; ArduPilot takes no other odometry
_ODOMETRY_PERIOD = NANOSECONDS // 50  # odometry is sent no more often: at 500 Hz it alone, 240 bytes each, would fill 921600 baud [ns]
_ROTORS_PERIOD = NANOSECONDS // 10   # between two reports that the rotors stand [ns]
_IGNORE_ATTITUDE = 128               # of SET_ATTITUDE_TARGET's type_mask: rates and thrust count


@dataclass(frozen=True, kw_only=True)
class MavlinkParameters:
    """Parameters of the node `mavlink`; all are read once, at the start."""

    vehicle: str = text("snapdragon_rates", doc="config/vehicles/<name>.yaml, or a file")
    link: str = text("/dev/ttyACM0@921600", doc="/dev/ttyACM0@921600, tcp:HOST:PORT")
    system: int = quantity(1, low=1, high=255, doc="the autopilot's system id; ours is the same, with a companion's component")


class Mavlink(Component[MavlinkParameters]):
    """Commands an autopilot over MAVLink.

    Attributes:
        offboard: state of the autopilot and of the transition to its following mode.
    """

    config_type = MavlinkParameters

    rates_thrust = Input(RatesThrust, "rates_thrust_command")
    command = Input(ControllerCommand, "controller/command")
    odometry = Input(OdometryState, "odometry")
    poll = Timer(_POLL, stamping=True)
    imu = Output(ImuSample, "imu/data_raw")
    rotors = Output(RotorState, "rotor_state")

    def __init__(self, config: MavlinkParameters) -> None:
        """
        Raises:
            ConfigError: there is no such vehicle, or it takes other commands.
            LinkError: the link cannot be opened.
            PerchError: pymavlink is not installed, no heartbeat arrives, or the autopilot is neither PX4 nor ArduPilot.
        """
        super().__init__(config)
        try:
            from pymavlink.dialects.v20 import common
        except ImportError:
            raise PerchError("the node mavlink needs pymavlink (an optional extra): python3 scripts/setup.py --extra mavlink") from None
        vehicle = commanded_vehicle(config.vehicle)
        self._thrust_max = 4.0 * vehicle.thrust_max / vehicle.mass
        link = Link(config.link)
        self._link: Link | None = link       # None: it has ended
        self._mavlink = common.MAVLink(None, srcSystem=config.system, srcComponent=_COMPONENT)
        self._mavlink.robust_parsing = True
        self.offboard, self._clock = Offboard(), ClockOffset()
        self._command: RatesThrust | None = None
        self._now: int | None = None         # of the last poll [ns]
        self._start_time = self._command_time = self._last_heartbeat = self._last_rotors = self._opened = self._jumps = 0
        self._corrupt_frames = self._reported_frames = self._held_polls = 0
        self._last_odometry: int | None = None  # stamp of the last odometry that was sent [ns]
        self._samples = 0                       # of the IMU that have come since the last heartbeat to the autopilot
        self._last_sample: int | None = None    # stamp of the autopilot's last sample, by its own clock [ns]
        try:
            self._identify(link)
        except BaseException:
            self.close()
            raise

    def _identify(self, link: Link) -> None:
        """Wait for the autopilot's first heartbeat."""
        last = time.monotonic() + _HANDSHAKE
        while not self.offboard.autopilot and (left := last - time.monotonic()) > 0.0:
            for message in self._mavlink.parse_buffer(link.read(left)) or ():
                if message.get_type() in ("HEARTBEAT", "BAD_DATA"):
                    self._handle_message(message, 0)
        if problem := self._absence_reason(0):
            raise PerchError(f"{self.config.link}: {problem}")
        self.offboard.arming.start(self.offboard.armed)

    # -- to the autopilot --------------------------------------------------------------------------------------------

    def on_rates_thrust(self, command: RatesThrust) -> None:
        """Store a command, which each poll sends until it is stale. Its age counts from its arrival: its stamp may be of another clock."""
        self._command, self._command_time, self._held_polls = command, self._now or 0, 0
        self.offboard.arming.command((self._now or 0) * 1e-9, command.armed)

    def on_command(self, command: ControllerCommand) -> None:
        """Stop the motors on KILL, unless it is stale, in any mode and at any height, also without a controller, or where a frame is lost."""
        if command.command != Command.KILL:
            return
        if command.is_stale(self._now or 0):
            self.warn(f"KILL of {seconds(command.stamp):.3f} s is too old: ignored; one with the stamp 0 never is")
            return
        self._command = None
        self.offboard.kill((self._now or 0) * 1e-9)
        self._send_command(_ARM_DISARM, 0.0, _FORCED)

    def on_odometry(self, state: OdometryState) -> None:
        """Send odometry to the autopilot's own estimator, in its axes, stamped by the host's clock (TIMESYNC); 50 Hz at most."""
        if self._last_odometry is not None and 0 <= state.stamp - self._last_odometry < _ODOMETRY_PERIOD:
            return
        self._last_odometry = state.stamp
        mavlink = self._mavlink
        x, y, z = frames.world(state.p_WB)
        measured = state.twist_covariance[0, 0] >= 0.0
        twist = (*frames.body(state.v_B), *frames.body(state.w_B)) if measured else (nan,) * 6
        i, j, k, w = frames.attitude(np.array(state.q_WB))
        self._send(mavlink.odometry_encode(
            max(state.stamp, 0) // 1000, _LOCAL_FRD, _BODY_FRD, x, y, z, (w, i, j, k), *twist,
            _upper(state.pose_covariance, frames.WORLD), _upper(state.twist_covariance, frames.BODY)))

    def _send(self, message: Any) -> None:
        if self._link is None:
            return
        try:
            self._link.write(message.pack(self._mavlink))
            self._mavlink.seq = (self._mavlink.seq + 1) % 256
        except LinkError as error:
            self._on_link_lost(error)

    def _send_set_point(self, command: RatesThrust) -> None:
        rates = frames.body(np.array(command.w_B)) if command.armed else np.zeros(3)
        thrust = min(max(command.thrust / self._thrust_max, 0.0), 1.0) if command.armed else 0.0
        self._send(self._mavlink.set_attitude_target_encode(
            0, self.config.system, 1, _IGNORE_ATTITUDE, (1.0, 0.0, 0.0, 0.0), *rates, thrust))

    # -- from it -----------------------------------------------------------------------------------------------------

    def on_poll(self, now: int) -> None:
        """Process received messages; send the command while it is fresh; once a second, heartbeat and TIMESYNC."""
        if self._now is None or (jump := clock_jump(self._now, now)):
            self._command, self._clock, self._start_time, self._last_heartbeat = None, ClockOffset(), now, now - NANOSECONDS
            self.offboard.set_time(now * 1e-9)
            if self._now is not None:
                self.warn(jump)
        self._now = now
        for message in self._mavlink.parse_buffer(self._received(now)) or ():
            self._handle_message(message, now)
        self._report_standing_rotors(now)
        command = self._command if self.offboard.takes_thrust else None
        self._held_polls += 1
        if command is not None and not (0 <= now - self._command_time <= _HELD and self._held_polls <= _HELD_POLLS):
            command = None
        if command is not None and not self.offboard.obeys(command.armed):
            stop = self.offboard.arming.stop
            if command.armed or self.offboard.following:
                self.log(LogLine("error", f"{stop.value}: commands with the motors on are not obeyed until they have them off" if stop and command.armed
                                 else "commands have the motors off, but a flight may have begun before them (was the controller started "
                                 "again?): not obeyed until the autopilot is disarmed by its pilot or its failsafe", 2.0))
            elif self.offboard.alive(now * 1e-9):
                self.log(LogLine("info", "a pilot flies: select this mode only while the controller flies (TRACKING or HOVERING), or on the ground", 10.0))
            command = None
        if command is not None:
            self._send_set_point(command)
        request = self.offboard.next_request(now * 1e-9, command is not None and command.armed, command is not None)
        if request is Request.MODE:
            self._send_command(_SET_MODE, 1.0, *_mode_words(self.offboard.mode))
        elif request is Request.ARM:
            self._send_command(_ARM_DISARM, 1.0)
        elif request is Request.DISARM:
            self._send_command(_ARM_DISARM, 0.0, _FORCED if self.offboard.forced or self.offboard.arming.stop is Stop.KILL else 0.0)
        if now - self._last_heartbeat >= NANOSECONDS:
            self._last_heartbeat = now
            self._send(self._mavlink.heartbeat_encode(18, 8, 0, 0, 4))                 # ONBOARD_CONTROLLER, INVALID, ACTIVE
            self._send(self._mavlink.timesync_encode(0, now))
            if not self.offboard.takes_thrust:
                for name in (GUID_OPTIONS, ANGLE_BOOST):
                    self._send(self._mavlink.param_request_read_encode(self.config.system, 1, name.encode(), -1))
            self._request_imu(now)
            self._diagnose(now)

    def _report_standing_rotors(self, now: int) -> None:
        """Report that the rotors stand while the autopilot is present and disarmed, and no command has the motors on."""
        if (self.offboard.alive(now * 1e-9) and not self.offboard.armed and not self.offboard.arming.wanted
                and not 0 <= now - self._last_rotors < _ROTORS_PERIOD):
            self._last_rotors = now
            self.rotors(RotorState(now, (0.0,) * 4, (0.0,) * 4))

    def _request_imu(self, now: int) -> None:
        """Request the IMU's rate while less than half of it comes, once a second; an autopilot that restarts forgets it."""
        samples, self._samples = self._samples, 0
        if 2 * samples < _IMU_RATE and not self._absence_reason(now):
            self._send_command(_SET_INTERVAL, _HIGHRES_IMU, 1e6 / _IMU_RATE)
            if now - self._start_time >= _HANDSHAKE * NANOSECONDS:
                self.warn(f"HIGHRES_IMU comes {samples} times a second instead of {_IMU_RATE}, as requested", min_interval=60.0)

    def _received(self, now: int) -> bytes:
        """Return the received bytes; reopen a link that has ended."""
        try:
            if self._link is None and not 0 <= now - self._opened < REOPEN * NANOSECONDS:
                self._opened = now
                self._link = Link(self.config.link)
            return b"" if self._link is None else self._link.read()
        except LinkError as error:
            self._on_link_lost(error)
            return b""

    def _on_link_lost(self, error: LinkError) -> None:
        """Close a link that has ended, and forget what only a link tells or has been told: presence, mode, set points, requests."""
        self.log(LogLine("error", str(error), 1.0))
        self.close()
        self.offboard = replace(self.offboard, following=False, _last_heartbeat=-1e9, _streaming_since=None, _last_request=-1e9)
        self._clock, self._last_sample = ClockOffset(), None

    def _send_command(self, command: int, *words: float) -> None:
        self._send(self._mavlink.command_long_encode(self.config.system, 1, command, 0, *words, *(0.0,) * (7 - len(words))))

    def _handle_message(self, message: Any, now: int) -> None:
        kind = message.get_type()
        if kind == "BAD_DATA":
            self._corrupt_frames += 1
        elif message.get_srcSystem() != self.config.system:
            return
        elif kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            self.offboard.heartbeat(now * 1e-9, message.autopilot, message.base_mode, message.custom_mode)
        elif kind == "HIGHRES_IMU":
            self._on_imu(message, now)
        elif kind == "PARAM_VALUE" and message.param_id == GUID_OPTIONS and isfinite(message.param_value):
            self.offboard.options = int(message.param_value)
        elif kind == "PARAM_VALUE" and message.param_id == ANGLE_BOOST and isfinite(message.param_value):
            self.offboard.angle_boost = int(message.param_value)
        elif kind == "TIMESYNC":
            if message.tc1 == 0:
                self._send(self._mavlink.timesync_encode(now, message.ts1))
            else:
                self._clock.answered(message.ts1, message.tc1, now)
        elif kind == "COMMAND_ACK" and message.result not in (0, 5) and message.target_component in (0, _COMPONENT):
            what = {_SET_MODE: "the mode", _ARM_DISARM: "disarming" if self.offboard.armed else "arming",
                    _SET_INTERVAL: f"to send HIGHRES_IMU at {_IMU_RATE} Hz"}.get(message.command)
            if what is not None:
                word = _RESULTS[message.result] if message.result < len(_RESULTS) else str(message.result)
                self.log(LogLine("error", f"the autopilot refuses {what}: {word}", 60.0 if message.command == _SET_INTERVAL else 1.0))
        elif kind == "STATUSTEXT":
            status = message.text if isinstance(message.text, str) else bytes(message.text).split(b"\0")[0].decode(errors="replace")
            self.log(LogLine("warning" if message.severity <= 4 else "info", f"autopilot: {status}", 1.0))

    def _on_imu(self, message: Any, now: int) -> None:
        self._samples += 1
        if self._can_convert_stamp(message.time_usec * 1000, now):
            f = frames.body(np.array([message.xacc, message.yacc, message.zacc]))
            w = frames.body(np.array([message.xgyro, message.ygyro, message.zgyro]))
            self.imu(ImuSample(message.time_usec * 1000 + self._clock.offset, tuple(w.tolist()), tuple(f.tolist())))

    def _can_convert_stamp(self, stamp: int, now: int) -> bool:
        """Return whether a sample's stamp, by the autopilot's clock [ns], can be converted; after a jump, request the offset."""
        if self._last_sample is not None and not 0 <= stamp - self._last_sample < MAX_STEP:
            self._jumps += 1
            if self._jumps < _JUMP_SAMPLES:
                return False
            self.warn(f"the autopilot's clock went from {self._last_sample * 1e-9:.3f} to {stamp * 1e-9:.3f} s at once: it may have restarted")
            self._clock = ClockOffset()
            self._send(self._mavlink.timesync_encode(0, now))
        self._last_sample, self._jumps = stamp, 0
        return self._clock.offset is not None

    def _problem(self, now: int) -> str:
        """Return why the autopilot cannot follow set points; empty if it can."""
        if absence := self._absence_reason(now):
            return absence
        if not self.offboard.takes_thrust:
            return (f"ArduPilot's {GUID_OPTIONS} needs bit 3 (value {THRUST_AS_THRUST}; else thrust is a climb rate), and {ANGLE_BOOST} must be 0 "
                    f"(else thrust depends on the tilt): they are {self.offboard.options} and {self.offboard.angle_boost}; not armed")
        return ""

    def _absence_reason(self, now: int) -> str:
        """Return why no usable autopilot is present; empty if there is one."""
        if not self.offboard.alive(now * 1e-9):
            noise = (f"; {self._corrupt_frames} corrupt frames: is the baud rate right?" if self._corrupt_frames
                     else ": check its power, link and system id")
            return f"no heartbeat of the autopilot{noise}"
        if self.offboard.autopilot not in (PX4, ARDUPILOT):
            return f"the autopilot is of MAVLink's type {self.offboard.autopilot}, not PX4 ({PX4}) or ArduPilot ({ARDUPILOT}): not armed"
        return ""

    def _diagnose(self, now: int) -> None:
        if (problem := self._problem(now)) and now - self._start_time >= HEARTBEAT_TIMEOUT * NANOSECONDS:
            self.log(LogLine("error", problem, 5.0))
        elif not problem and self._corrupt_frames > self._reported_frames:
            self.warn("corrupt frames received from the autopilot: check the link and its baud rate", min_interval=5.0)
            self._reported_frames = self._corrupt_frames
        self.diagnostics(Diagnostics(now, {"armed": self.offboard.armed, "following": self.offboard.following,
                                           "torn_frames": self._corrupt_frames, "clock_offset_s": (self._clock.offset or 0) * 1e-9},
                                     2 if problem else 0, problem or "ok"))

    def close(self) -> None:
        """Close the link: the autopilot's failsafe for the loss of set points takes effect."""
        if self._link is not None:
            self._link.close()
            self._link = None


def _mode_words(mode: int) -> tuple[float, ...]:
    """Return the parameters of MAV_CMD_DO_SET_MODE for a custom mode: main and sub mode for PX4, one number for ArduPilot."""
    return (float(mode >> 16 & 255), float(mode >> 24 & 255)) if mode >> 16 else (float(mode),)


def _upper(covariance: np.ndarray, axes: np.ndarray) -> list[float]:
    """Return the upper triangle, row by row, of a covariance in other axes; its first entry is NaN if it is unknown."""
    upper = frames.covariance(covariance, axes)[np.triu_indices(6)].tolist()
    return upper if covariance[0, 0] > 0.0 else [nan, *upper[1:]]
