"""Values of flight control: trajectories, commands and the controller's answers. Stamps are whole nanoseconds."""

from __future__ import annotations

from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple

from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values.stamps import STALE, nanoseconds, seconds

Floats = tuple[float, ...]


class AtEnd(IntEnum):
    """Action at the end of a trajectory; the values of perch_msgs/Trajectory."""

    HOLD = 0
    CONTACT = 1
    LAND = 2
    RECOVER = 3


class TrajectoryOrder(NamedTuple):
    """A trajectory to fly (channel `trajectory`) or to keep ready (channel `recovery`); fields as in perch_msgs/Trajectory.

    Attributes:
        id: chosen by the sender.
        trajectory: its `start_time` is a whole number of nanoseconds, as in a stamp.
        at_end: action at its end, a number of `AtEnd`; a planner may have sent another, which the mission refuses.
        contact_time: time-out of the wait for a contact after the end [s].
        recovery_start: time at which an appended recovery begins, negative: none [s].
    """

    id: int
    trajectory: FlatTrajectory | SampledTrajectory
    at_end: int = AtEnd.HOLD
    contact_time: float = 0.0
    recovery_start: float = -1.0

    @classmethod
    def of(cls, id: int, trajectory: FlatTrajectory | SampledTrajectory, at_end: int = AtEnd.HOLD, contact_time: float = 0.0,
           recovery_start: float = -1.0) -> TrajectoryOrder:
        """Return an order whose start is rounded to whole nanoseconds, the resolution of a message."""
        start = seconds(nanoseconds(trajectory.start_time))
        if start != trajectory.start_time:
            trajectory = replace(trajectory, start_time=start)
        return cls(id, trajectory, at_end, contact_time, recovery_start)

    @property
    def contact_after(self) -> float | None:
        """Time from the start to the planned contact [s]; None: no contact is planned."""
        if self.at_end not in (AtEnd.CONTACT, AtEnd.RECOVER):
            return None
        return self.recovery_start if self.recovery_start > 0.0 else self.trajectory.duration


class Command(IntEnum):
    """Command to the controller; the values of perch_msgs/ControllerCommand."""

    DISARM = 0
    ARM = 1
    HOVER = 2
    LAND = 3
    ATTACHED = 4
    KILL = 5


class ControllerCommand(NamedTuple):
    """A command to the controller other than a trajectory; fields as in perch_msgs/ControllerCommand.

    Attributes:
        command: a number of `Command`; a sender may have sent another, which the receiver refuses.
    """

    stamp: int
    command: int
    reason: str

    def is_stale(self, now: int) -> bool:
        """Whether it is too old to be obeyed at a time [ns]; a command with the stamp 0, of a sender without a clock, never is."""
        return 0 < self.stamp < now - STALE


class MotorCommand(NamedTuple):
    """Rotor speeds [rad/s], 4 floats, for the step with this stamp [ns]; not armed: motors off."""

    stamp: int
    armed: bool
    rotor_speed: Floats


class RatesThrust(NamedTuple):
    """Body rates [rad/s], 3 floats, and collective thrust / mass [m/s^2] for an inner rate loop; stamp of the step [ns]."""

    stamp: int
    armed: bool
    w_B: Floats
    thrust: float


class AttitudeThrust(NamedTuple):
    """Attitude xyzw, 4 floats, feed-forward body rates [rad/s], 3 floats, and collective thrust / mass [m/s^2] for an inner
    attitude loop at the step with this stamp [ns]."""

    stamp: int
    armed: bool
    q_WB: Floats
    w_B: Floats
    thrust: float


class ControllerStatus(NamedTuple):
    """State of the controller and its supervisor; fields as in perch_msgs/ControllerStatus."""

    stamp: int
    state: int
    controller: str
    trajectory_id: int
    trajectory_time: float
    trajectory_duration: float
    position_error: float
    odometry_age: float
    thrust_margin: float
    thrust_ratio: float
    message: str


class ControlReference(NamedTuple):
    """Reference of the controller at a step; fields as in perch_msgs/ControlReference, vectors as tuples of floats."""

    stamp: int
    trajectory_id: int
    p: Floats
    q: Floats
    v: Floats
    a: Floats
    w: Floats
    dw: Floats
    thrust: float
    moment: Floats


class SetControllerRequest(NamedTuple):
    """Request of `set_controller`: the control law, with or without L1 adaptation."""

    type: str
    adaptive: bool


class SetControllerResponse(NamedTuple):
    """Response of `set_controller`; `error_code` as in perch_msgs/srv/SetController."""

    success: bool
    error_code: int
    message: str


class TriggerRequest(NamedTuple):
    """A request without content (std_srvs/Trigger)."""


class TriggerResponse(NamedTuple):
    """Response to `TriggerRequest`."""

    success: bool
    message: str
