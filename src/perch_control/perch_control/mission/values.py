"""Inputs and outputs of the mission at a tick, and the values that they hold."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

import numpy as np

from perch_control.modes import State as ControllerState
from perch_control.period import NOMINAL_PERIOD
from perch_core.trajectory import FlatTrajectory, SampledTrajectory, StateSample
from perch_core.values import AtEnd, Command, MappedPowerline

TICK = 0.02  # the mission decides so often [s]


class Phase(str, Enum):
    """Phases, named as in the action's feedback."""

    IDLE = "idle"
    ARMING = "arming"
    TAKE_OFF = "take_off"
    SEARCHING = "searching"
    PLANNING = "planning"
    TRACKING = "tracking"
    INSPECTING = "inspecting"
    VERIFYING = "verifying"
    PERCHED = "perched"
    RECOVERING = "recovering"

    @property
    def progress(self) -> float:
        """Completed fraction of the mission, 0 to 1."""
        order = (Phase.ARMING, Phase.TAKE_OFF, Phase.SEARCHING, Phase.PLANNING, Phase.TRACKING, Phase.VERIFYING, Phase.PERCHED)
        phase = Phase.TRACKING if self is Phase.INSPECTING else self
        return order.index(phase) / (len(order) - 1) if phase in order else 0.0


class Result(IntEnum):
    """Error codes of the Perch action."""

    PERCHED = 0
    NOT_FOUND = 1
    REFUSED = 2
    MISSED = 3
    TRACKING_LOST = 4
    CANCELLED = 5
    TIMEOUT = 6
    BAD_GOAL = 7
    CRASHED = 8
    PERCHED_ALREADY = 9


@dataclass(frozen=True)
class State:
    """Estimated state of the vehicle.

    Attributes:
        p_WB: position [m], shape (3,).
        q_WB: attitude xyzw, shape (4,).
        v_WB: velocity in W [m/s], shape (3,).
        w_WB_B: angular velocity in B [rad/s], shape (3,).
    """

    p_WB: np.ndarray
    q_WB: np.ndarray
    v_WB: np.ndarray
    w_WB_B: np.ndarray


@dataclass(frozen=True)
class Target:
    """The place to perch on, as localised: the pad, or a point on a powerline with the b3 of the perch.

    Attributes:
        time: stamp of the image [s].
        p_WS: position in W [m], shape (3,).
        q_WS: attitude xyzw, shape (4,).
        position_sigma: largest 1-sigma of the position relative to the vehicle [m].
        attitude_sigma: the same of the attitude [rad].
        lines: mapped powerlines nearest to the target, including its own; empty for a pad.
        line: id of the target's line in that map.
    """

    time: float
    p_WS: np.ndarray
    q_WS: np.ndarray
    position_sigma: float
    attitude_sigma: float
    lines: tuple[MappedPowerline, ...] = ()
    line: int = 0


@dataclass(frozen=True)
class Goal:
    """Goal of the mission: that of the Perch action, with its defaults filled in."""

    takeoff_height: float
    search_timeout: float
    perch_point: np.ndarray = field(default_factory=lambda: np.zeros(3))
    perch_pitch: float = 0.0
    perception_aware: bool = False
    search_position: np.ndarray | None = None
    search_yaw: float | None = None
    inclination_hint: float | None = None
    replan: bool = False
    attempts: int = 1


@dataclass(frozen=True)
class PlanQuery:
    """A request to the planner.

    Attributes:
        start_time: when the trajectory shall start [s].
        p, v: start position [m] and velocity [m/s] in W, shapes (3,); the acceleration there is zero.
        yaw: start yaw [rad].
        target: where to perch.
        goal: goal of the mission.
        latency: time from the request to the use of the plan [s].
        current: the trajectory being flown, to be continued from `start_time`; None: start from p, v.
        duration: time from the start to contact [s] that the new plan should keep; None: chosen by the planner.
        state: full state at the start, of a powerline plan that is being flown; None: level, with this yaw.
        recovery: plan only the way out, from `state`, or from `current` at `start_time`.
        perch_pose: end pose (position [m], attitude xyzw); None: it follows from the target and the goal's pitch.
    """

    start_time: float
    p: np.ndarray
    v: np.ndarray
    yaw: float
    target: Target
    goal: Goal
    latency: float = 0.0
    current: FlatTrajectory | SampledTrajectory | None = None
    duration: float | None = None
    state: StateSample | None = None
    recovery: bool = False
    perch_pose: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True)
class Plan:
    """A plan of the planner.

    Attributes:
        trajectory: the trajectory to fly.
        duration: time from its start to the contact [s].
        at_end, recovery_start: as in `TrajectoryOrder`.
    """

    trajectory: FlatTrajectory | SampledTrajectory
    duration: float
    at_end: AtEnd = AtEnd.CONTACT
    recovery_start: float = -1.0

    @property
    def start_time(self) -> float:
        """Start of the trajectory [s]."""
        return self.trajectory.start_time

    @property
    def end(self) -> float:
        """Time of the planned contact [s]."""
        return self.start_time + self.duration

    def starting(self, time: float) -> Plan:
        """Return the plan with another start time [s]; a vehicle at rest may begin at any time."""
        return replace(self, trajectory=replace(self.trajectory, start_time=time))


@dataclass(frozen=True)
class Refusal:
    """Refusal of a plan, with the planner's message."""

    message: str


@dataclass(frozen=True)
class Inputs:
    """Inputs of the mission at a tick."""

    time: float
    state: State
    estimator_ready: bool
    controller: ControllerState
    controller_message: str
    trajectory_id: int
    target: Target | None
    specific_force_B: np.ndarray  # IMU samples since the last tick [m/s^2], shape (n, 3)
    plan: Plan | Refusal | None = None
    cancel: bool = False
    imu_period: float = NOMINAL_PERIOD  # [s]
    way_out: Plan | Refusal | None = None
    controller_time: float = math.inf  # stamp of the controller's state [s]; -inf: it is not known


@dataclass(frozen=True)
class Outcome:
    """How a goal ended."""

    result: Result
    message: str
    contact_time: float = float("nan")


@dataclass
class Outputs:
    """Outputs of the mission after a tick."""

    commands: list[tuple[Command, str]] = field(default_factory=list)
    reference: FlatTrajectory | None = None    # a trajectory of the mission's own: take-off, search
    perch: Plan | None = None                  # a planned perch to be flown
    way_out: Plan | None = None                # a recovery to keep ready, out of the trajectory with this id
    trajectory_id: int = 0
    query: PlanQuery | None = None
    way_out_query: PlanQuery | None = None     # of a perch on a surface
    outcome: Outcome | None = None
