"""Sequence that brings a MAVLink autopilot to follow set points: stream them, set its mode, arm. Pure: times are arguments."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from perch_autopilot.arming import LATENCY, Arming, Stop

PX4, ARDUPILOT = 12, 3              # MAV_AUTOPILOT
ARMED = 128                         # MAV_MODE_FLAG_SAFETY_ARMED
OFFBOARD, GUIDED_NOGPS = 6 << 16, 20  # custom modes: PX4's main mode, ArduPilot's copter mode
GUID_OPTIONS = "GUID_OPTIONS"       # parameter of ArduPilot
THRUST_AS_THRUST = 8                # its bit SetAttitudeTarget_ThrustAsThrust: a thrust, no climb rate
ANGLE_BOOST = "ATC_ANGLE_BOOST"     # parameter of ArduPilot: 0, or thrust is multiplied by a function of the tilt, which is 0 at 90 deg
MIN_STREAMING_TIME = 0.5            # set points are sent for so long before the mode is requested; PX4 requires more than 2 Hz [s]
REQUEST_PERIOD = 1.0                # between two requests [s]
RESTART_GAP = 0.5                   # commands that have stopped for longer may come from a controller that was started again [s]
KILL_TIME = 5.0                     # for which KILL is repeated, unless a heartbeat has the autopilot disarmed [s]
HEARTBEAT_TIMEOUT = 2.0             # without a heartbeat for so long the autopilot is considered absent [s]


class Request(Enum):
    """Request to the autopilot."""

    NOTHING = 0
    MODE = 1
    ARM = 2
    DISARM = 3


@dataclass
class Offboard:
    """State of the transition to offboard (PX4) or guided (ArduPilot) flight.

    Attributes:
        autopilot: PX4, ARDUPILOT or another number, from the heartbeat; 0: no heartbeat was received.
        armed: whether the autopilot was armed at its last heartbeat, also where that came by a link that has ended.
        following: whether the autopilot is in the mode in which it follows set points.
        options: ArduPilot's GUID_OPTIONS; 0 until received.
        angle_boost: ArduPilot's ATC_ANGLE_BOOST; None until received.
        arming: whether commands with the motors on are obeyed; not of the autopilot's state, which a link that is lost resets.
        forced: the autopilot was commanded with the motors on since it was last disarmed, so it must disarm also in flight.
        commanding: commands have come without a gap since the motors were commanded on, or since the autopilot was disarmed. Only then
            are commands with the motors off obeyed: a controller that was started again in flight is disarmed.
    """

    autopilot: int = 0
    armed: bool = False
    following: bool = False
    options: int = 0
    angle_boost: int | None = None
    arming: Arming = field(default_factory=Arming, compare=False)
    forced: bool = False
    commanding: bool = False
    _disarm_until: float = -1e9
    _last_heartbeat: float = -1e9
    _streaming_since: float | None = None
    _last_streaming: float = -1e9
    _last_request: float = -1e9

    @property
    def mode(self) -> int:
        """Custom mode in which the autopilot follows set points."""
        return GUIDED_NOGPS if self.autopilot == ARDUPILOT else OFFBOARD

    def heartbeat(self, now: float, autopilot: int, base_mode: int, custom_mode: int) -> None:
        """Record a heartbeat of the autopilot at a time [s]."""
        self._last_heartbeat, self.autopilot, self.armed = now, autopilot, bool(base_mode & ARMED)
        self.following = custom_mode == self.mode
        stale = not self.armed and now - (self._disarm_until - KILL_TIME) < LATENCY  # may be of before KILL
        if not stale:
            self.arming.report(now, self.armed)
            if not self.armed:
                self._disarm_until = -1e9

    def set_time(self, now: float) -> None:
        """Take a time [s] of a clock that has jumped; commands have had no gap by it."""
        self._last_streaming, self._disarm_until = now, -1e9

    def kill(self, now: float) -> None:
        """Record KILL, which the autopilot is sent, at a time [s]. It is not repeated for long: a pilot may have armed it then."""
        self.arming.halt(Stop.KILL)
        self._disarm_until, self._last_request = now + KILL_TIME, now

    @property
    def takes_thrust(self) -> bool:
        """Whether the autopilot applies the thrust of a set point as it is: not as a climb rate, and at any tilt."""
        return self.autopilot == PX4 or (
            self.autopilot == ARDUPILOT and bool(self.options & THRUST_AS_THRUST) and self.angle_boost == 0)

    def alive(self, now: float) -> bool:
        """Return whether the last heartbeat is recent at a time [s]."""
        return 0.0 <= now - self._last_heartbeat < HEARTBEAT_TIMEOUT

    def obeys(self, armed: bool) -> bool:
        """Return whether the autopilot may be sent a command with the motors on (`armed`) or off.

        In another mode, set points without thrust would let its pilot enter this mode, and stop the motors. After a lost link the mode
        is unknown.
        """
        elsewhere = not self.following and self._last_heartbeat > -1e9
        return self.arming.stop is None if armed else not self.armed or self.commanding and not elsewhere

    def next_request(self, now: float, wanted: bool, streaming: bool) -> Request:
        """Return the request to send at a time, at most one each `REQUEST_PERIOD` seconds.

        The mode is requested with the motors off only: in flight the pilot selects it, and leaves it. Who disarms the autopilot, a
        pilot or a failsafe, is obeyed until the commands have the motors off, too.

        Args:
            now: time [s].
            wanted: whether the motors are to turn.
            streaming: whether set points are being sent.
        """
        if not streaming:
            self._streaming_since = None
        elif self._streaming_since is None or now < self._streaming_since:
            self._streaming_since = now
        if streaming:
            self._last_streaming = now
        continued = self.commanding and 0.0 <= now - self._last_streaming <= RESTART_GAP
        self.commanding = continued or streaming and (wanted or self.alive(now) and not self.armed)
        request = Request.NOTHING
        stopped = streaming and not wanted and self.commanding and self.armed and self.following  # by commands with the motors off
        if self.arming.stop is Stop.KILL:
            request = Request.DISARM if stopped or now <= self._disarm_until else request
        elif not self.alive(now) or self.autopilot not in (PX4, ARDUPILOT):
            return request
        elif not wanted:
            request = Request.DISARM if stopped else request
            self.forced = self.forced and self.armed
        elif self.armed:
            self.forced = True
            if self._last_heartbeat - self._last_request >= LATENCY:  # no request can have disarmed it since
                self.arming.report(now, True)
        elif self.arming.stop is None and self._streaming_since is not None and now - self._streaming_since >= MIN_STREAMING_TIME:
            request = Request.ARM if self.following else Request.MODE
        if request is Request.NOTHING or 0.0 <= now - self._last_request < REQUEST_PERIOD:
            return Request.NOTHING
        self._last_request = now
        return request
