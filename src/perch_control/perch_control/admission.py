"""Admission of trajectories: complete, finite, without jumps, beginning where the vehicle is."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from perch_control.reference import FlatReference, SampledReference, Setpoint
from perch_core import bernstein
from perch_core.errors import PerchError
from perch_core.so3 import quat_rotate
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import AtEnd, TrajectoryOrder, limits
from perch_core.vehicle import GRAVITY, Vehicle

_START_AHEAD_MAX = 60.0  # a trajectory is not kept for longer before its start [s]
_START_DELAY_MAX = 0.5  # a trajectory is not flown where its start lies further in the past [s]
START_GAP = 0.35        # largest distance between a trajectory's start and the vehicle, which feedback closes [m]
CONTACT_EARLY = 0.15    # a contact may occur so long before the planned one [s]
_START_SPEED_GAP = 1.0  # the same for the velocity [m/s]
_PLACES = np.linspace(0.0, 1.0, 21)  # of a segment, where a polynomial is evaluated
_STEP = 0.02            # largest step inside a trajectory [m]; ten times this for the velocity [m/s]
_MOTION_TIME = 0.05     # over so long, samples change their velocity as their attitudes and thrusts do, [s] ...
_MOTION_GAP = 3.0       # ... within this acceleration: more than the drag that a plan may contain [m/s^2]


class TrajectoryRefused(PerchError):
    """Raised when a trajectory is not flown; the message gives the reason."""


@dataclass(frozen=True)
class Order:
    """A trajectory to fly.

    Attributes:
        id: given by the planner's caller.
        source: reference with `duration` and `setpoint(t)`.
        start: stamp of its start [s].
        at_end: what to do at the end.
        contact_time: how long a contact is awaited after the end [s].
        recovery_start: time after the start at which an appended recovery begins, negative: none [s].
    """

    id: int
    source: FlatReference | SampledReference
    start: float
    at_end: AtEnd = AtEnd.HOLD
    contact_time: float = 0.0
    recovery_start: float = -1.0


def check_order(order: TrajectoryOrder, vehicle: Vehicle) -> None:
    """Refuse an order that is invalid in any state of the vehicle, or too large to be checked within a control period.

    Args:
        order: the order.
        vehicle: gives the greatest thrust.

    Raises:
        TrajectoryRefused: with the value and its limit.
    """
    trajectory, duration = order.trajectory, order.trajectory.duration
    if problem := limits.problem(order):
        raise TrajectoryRefused(problem)
    if not order.recovery_start <= duration + 1e-6:
        raise TrajectoryRefused(f"recovery_start {order.recovery_start} s is not within the trajectory's {duration:.3f} s")
    if isinstance(trajectory, FlatTrajectory):
        _check_polynomials(trajectory)
    else:
        _check_samples(trajectory, vehicle)


def _check_polynomials(trajectory: FlatTrajectory) -> None:
    """Refuse positions, velocities and accelerations beyond their limits, at `_PLACES`: coefficients may be far larger than values."""
    c, T = trajectory.coefficients, trajectory.durations[:, None, None]
    rate = bernstein.derivative(c) / T if trajectory.degree else np.zeros((1, 1))
    second = bernstein.derivative(rate) / T if trajectory.degree > 1 else np.zeros((1, 1))
    for name, values, limit in (("position", c, limits.POSITION), ("velocity", rate, limits.VELOCITY), ("acceleration", second, limits.ACCELERATION)):
        _check_size(name, values @ bernstein.basis(values.shape[-1] - 1, _PLACES).T, limit.high)


def _check_samples(trajectory: SampledTrajectory, vehicle: Vehicle) -> None:
    """Refuse quaternions that are not of unit length, rotor thrusts above twice the vehicle's greatest, and a motion that does not
    follow from both on this vehicle."""
    check_quaternions(trajectory)
    _check_size("rotor thrust", trajectory.rotor_thrust, 2.0 * vehicle.thrust_max)
    _check_motion(trajectory, vehicle.mass)


def check_quaternions(trajectory: SampledTrajectory) -> None:
    """Refuse quaternions that are not of unit length.

    Raises:
        TrajectoryRefused: with the norm.
    """
    norms = np.linalg.norm(trajectory.q, axis=-1)
    if not np.abs(norms - 1.0).max() <= 1e-3:
        k = int(np.abs(norms - 1.0).argmax())
        raise TrajectoryRefused(f"quaternion of sample {k} has norm {norms[k]:.4f}, not 1")


def _check_motion(trajectory: SampledTrajectory, mass: float) -> None:
    """Refuse samples whose velocity does not change as m dv/dt = f b3 - m g e3 says, as those with quaternions in another order."""
    t, e3 = trajectory.times, np.array([0.0, 0.0, 1.0])
    a = trajectory.rotor_thrust.sum(axis=1, keepdims=True) / mass * quat_rotate(trajectory.q, e3) - GRAVITY * e3
    gained = np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(t)[:, None], axis=0)
    gap = trajectory.v - np.concatenate([np.zeros((1, 3)), gained])
    grid = np.linspace(0.0, t[-1], ceil(t[-1] / _MOTION_TIME) + 1)
    steps = np.diff(np.stack([np.interp(grid, t, column) for column in gap.T], axis=1), axis=0)
    gaps = np.linalg.norm(steps, axis=1) / _MOTION_TIME
    if not gaps.max() <= _MOTION_GAP:
        k = int(gaps.argmax())
        raise TrajectoryRefused(f"attitude and thrusts give another acceleration than the velocity, by {gaps[k]:.1f} m/s^2 at {grid[k]:.3f} s; "
                                f"at most {_MOTION_GAP:g} m/s^2 is allowed")


def _check_size(name: str, values: np.ndarray, limit: float) -> None:
    greatest = float(np.abs(values).max())
    if not greatest <= limit:
        raise TrajectoryRefused(f"{name} of {greatest:g} is beyond {limit:g}")


def check_joints(trajectory: FlatTrajectory | SampledTrajectory) -> None:
    """Refuse a trajectory that is not continuous in position and velocity.

    Raises:
        TrajectoryRefused: with time and size of the step.
    """
    if isinstance(trajectory, FlatTrajectory):
        c, T = trajectory.coefficients, trajectory.durations[:, None]
        rate = bernstein.derivative(c)
        steps = np.linalg.norm(c[1:, :3, 0] - c[:-1, :3, -1], axis=-1)
        kinks = np.linalg.norm(rate[1:, :3, 0] / T[1:] - rate[:-1, :3, -1] / T[:-1], axis=-1)
        places = np.cumsum(trajectory.durations)[:-1]
    else:
        dt = np.diff(trajectory.times)[:, None]
        mean = 0.5 * (trajectory.v[1:] + trajectory.v[:-1])
        steps = np.linalg.norm(np.diff(trajectory.p, axis=0) - mean * dt, axis=-1)
        kinks = np.linalg.norm(np.diff(trajectory.v, axis=0), axis=-1) - 60.0 * dt[:, 0]
        places = trajectory.times[1:]
    if len(steps) and not steps.max() <= _STEP:
        k = int(steps.argmax())
        raise TrajectoryRefused(f"position jumps by {steps[k]:.3f} m at {places[k]:.3f} s; at most {_STEP:g} m is allowed")
    if len(kinks) and not kinks.max() <= 10.0 * _STEP:
        k = int(kinks.argmax())
        raise TrajectoryRefused(f"velocity jumps by {kinks[k]:.3f} m/s at {places[k]:.3f} s; at most {10 * _STEP:g} m/s is allowed")


def check_start(order: Order, now: float, present: Setpoint) -> None:
    """Refuse a trajectory that does not begin near the present time, or not near the vehicle's position and velocity.

    Args:
        order: the order.
        now: time of the step [s].
        present: expected position and velocity at the start, from the running reference or the state.

    Raises:
        TrajectoryRefused: with the gap and its limit.
    """
    delay = now - order.start
    if delay > _START_DELAY_MAX:
        raise TrajectoryRefused(f"starts {delay:.2f} s in the past; at most {_START_DELAY_MAX:g} s is allowed")
    if -delay > _START_AHEAD_MAX:
        raise TrajectoryRefused(f"starts {-delay:.2f} s in the future; at most {_START_AHEAD_MAX:g} s is allowed")
    begin = order.source.setpoint(max(delay, 0.0))
    gap = float(np.linalg.norm(np.subtract(begin.p, present.p)))
    if not gap <= START_GAP:
        raise TrajectoryRefused(f"starts {gap:.2f} m away from the vehicle; at most {START_GAP:g} m is allowed")
    speed = float(np.linalg.norm(np.subtract(begin.v, present.v)))
    if not speed <= _START_SPEED_GAP:
        raise TrajectoryRefused(f"starts {speed:.2f} m/s from the vehicle's velocity; at most {_START_SPEED_GAP:g} m/s is allowed")
