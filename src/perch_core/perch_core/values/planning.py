"""Requests to the planners and their answers. Stamps are whole nanoseconds, vectors arrays (3,), quaternions xyzw (4,)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values.perching import MappedPowerline

OPTIONS = ("impact_acceleration", "impact_speed_min", "impact_speed_max", "thrust_max", "thrust_min")
"""Optional fields of `PerchPlanRequest`; None: the planner's setting applies."""


def _zero() -> np.ndarray:
    return np.zeros(3)


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """The range of one quantity of a plan against its limits; fields as in perch_msgs/Certificate.

    Attributes:
        quantity: thrust, speed, height, clearance, body_rate, rotor_thrust and others.
        unit: of the values.
        lower_limit, upper_limit: required bounds, infinite where there is none.
        minimum, maximum: bounds of the quantity, infinite where none was asked for.
        time_of_minimum, time_of_maximum: times of the samples nearest to them [s]; nan: none.
        method: bernstein, sturm, interval: the bounds are proved; dense: they are extremes of samples, without proof.
        holds: whether the limits are kept.
    """

    quantity: str
    unit: str
    lower_limit: float
    upper_limit: float
    minimum: float
    maximum: float
    time_of_minimum: float
    time_of_maximum: float
    method: str
    holds: bool

    @property
    def margin(self) -> float:
        """Distance from the nearer limit, negative where it is violated, in the quantity's unit."""
        return min(self.minimum - self.lower_limit, self.upper_limit - self.maximum)

    def __str__(self) -> str:
        kept = "kept" if self.method == "dense" else "proved"
        return (f"{self.quantity} in [{self.minimum:.4g}, {self.maximum:.4g}] {self.unit}, required "
                f"[{self.lower_limit:.4g}, {self.upper_limit:.4g}]: {kept if self.holds else f'NOT {kept}'} ({self.method})")


@dataclass(frozen=True, kw_only=True)
class PerchPlanRequest:
    """Request of `plan_perch` and `plan_way_out`; fields as in perch_msgs/srv/PlanPerch, with None for NaN options.

    Attributes:
        start: stamp of the trajectory's start [ns].
        p, v, a, j: start state in W, shapes (3,).
        yaw, yaw_rate: [rad], [rad/s].
        current: the trajectory being flown, to be continued from `start`; None: start from p, v, a, j, yaw.
        p_WS, q_WS: pose of the surface at `start`, shapes (3,) and (4,).
        target_velocity: [m/s], shape (3,).
        waypoints: positions to pass [m], shape (k, 3).
        segment_times: initial guess [s]; empty: the planner's.
        impact_acceleration, impact_speed_min, impact_speed_max, thrust_max, thrust_min: [m/s^2], [m/s], [N]; None: the planner's.
        thrust_ratio: actual thrust of the rotors over that of the vehicle file; 0: as in the file.
        objective: 0 the planner's, 4 snap, 3 jerk.
        minimum_time: shorten the plan until a bound is active.
    """

    start: int
    p: np.ndarray
    v: np.ndarray = field(default_factory=_zero)
    a: np.ndarray = field(default_factory=_zero)
    j: np.ndarray = field(default_factory=_zero)
    yaw: float = 0.0
    yaw_rate: float = 0.0
    current: FlatTrajectory | SampledTrajectory | None = None
    p_WS: np.ndarray
    q_WS: np.ndarray
    target_velocity: np.ndarray = field(default_factory=_zero)
    waypoints: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    segment_times: tuple[float, ...] = ()
    impact_acceleration: float | None = None
    impact_speed_min: float | None = None
    impact_speed_max: float | None = None
    thrust_max: float | None = None
    thrust_min: float | None = None
    thrust_ratio: float = 0.0
    objective: int = 0
    minimum_time: bool = False


@dataclass(frozen=True, kw_only=True)
class PerchPlan:
    """Answer of `plan_perch` and `plan_way_out`; fields as in perch_msgs/srv/PlanPerch.

    Attributes:
        success: there is a plan.
        error_code: as in the service.
        message: what failed, by how much, and what to change.
        trajectory: from the request's start to the contact; None without success.
        contact_time: time-out of the wait for contact after the end [s]; 0 for a way out, which ends in a hover.
        certificates: every bound with its proof.
        iterations: number of QPs solved.
        solve_time: wall-clock time [s]; it varies between runs, and no decision may depend on it.
    """

    success: bool
    error_code: int = 0
    message: str = ""
    trajectory: FlatTrajectory | SampledTrajectory | None = None
    contact_time: float = 0.0
    certificates: tuple[Certificate, ...] = ()
    iterations: int = 0
    solve_time: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PowerlinePlanRequest:
    """Request of `plan_powerline`; fields as in perch_msgs/srv/PlanPowerline.

    Attributes:
        start: stamp of the trajectory's start [ns].
        p, q, v, w: start pose and twist, w in B; shapes (3,), (4,), (3,), (3,).
        rotor_thrust: [N], 4 values, or empty: hover.
        lines: all segments to avoid, the target among them.
        target_line: id of the segment to perch on.
        perch_pose: final pose (position [m], attitude); None: from `perch_point` and `perch_pitch`.
        perch_point: on the line [m], shape (3,).
        perch_pitch: tilt of b3 from the vertical about the line [rad].
        end_velocity: [m/s], shape (3,).
        perception_aware, with_recovery, recovery_only: as in the service.
        deadline: wall-clock limit from the request on [s], at most 10 s; 0: the planner's.
    """

    start: int
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray = field(default_factory=_zero)
    w: np.ndarray = field(default_factory=_zero)
    rotor_thrust: tuple[float, ...] = ()
    lines: tuple[MappedPowerline, ...] = ()
    target_line: int = 0
    perch_pose: tuple[np.ndarray, np.ndarray] | None = None
    perch_point: np.ndarray = field(default_factory=_zero)
    perch_pitch: float = 0.0
    end_velocity: np.ndarray = field(default_factory=_zero)
    perception_aware: bool = False
    with_recovery: bool = False
    recovery_only: bool = False
    deadline: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PowerlinePlan:
    """Answer of `plan_powerline`; fields as in perch_msgs/srv/PlanPowerline.

    Attributes:
        trajectory: perch and, where asked, recovery from `recovery_start` on; None without success.
        at_end, contact_time, recovery_start: of the trajectory, as in perch_msgs/Trajectory.
    """

    success: bool
    error_code: int = 0
    message: str = ""
    trajectory: FlatTrajectory | SampledTrajectory | None = None
    at_end: int = 0
    contact_time: float = 0.0
    recovery_start: float = -1.0
    certificates: tuple[Certificate, ...] = ()
    perch_time: float = 0.0
    recovery_time: float = 0.0
    solve_time: float = 0.0
    recovery_solve_time: float = 0.0
    iterations: int = 0
    solver: str = ""
