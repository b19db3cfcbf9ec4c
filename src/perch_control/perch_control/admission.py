"""Which trajectories may be flown: complete, finite, without jumps, beginning where the vehicle is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from perch_control.flight_settings import FlightSettings
from perch_control.reference import FlatReference, SampledReference, Setpoint
from perch_core import bernstein
from perch_core.errors import PerchError
from perch_core.trajectory import FlatTrajectory, SampledTrajectory


class AtEnd(IntEnum):
    """What to do at the end of a trajectory; the values of `perch_msgs/Trajectory`."""

    HOLD = 0
    CONTACT = 1
    LAND = 2
    RECOVER = 3


class TrajectoryRefused(PerchError):
    """The trajectory is not flown; the message says why."""


@dataclass(frozen=True)
class Order:
    """A trajectory to fly.

    Attributes:
        id: given by the planner's caller.
        source: reference with `duration` and `setpoint(t)`.
        start: stamp of its start [s].
        at_end: what to do at the end.
        contact_time: how long a contact is awaited after the end [s].
        recovery_start: time at which an appended recovery begins, negative: none [s].
    """

    id: int
    source: FlatReference | SampledReference
    start: float
    at_end: AtEnd = AtEnd.HOLD
    contact_time: float = 0.0
    recovery_start: float = -1.0


def check_joints(trajectory: FlatTrajectory | SampledTrajectory, gap: float) -> None:
    """Refuse a trajectory that is not continuous in position and velocity.

    Args:
        trajectory: what to check.
        gap: largest step in position [m]; ten times this in velocity [m/s].

    Raises:
        TrajectoryRefused: with place and size of the step.
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
        norms = np.linalg.norm(trajectory.q, axis=-1)
        if np.abs(norms - 1.0).max() > 1e-2:
            k = int(np.abs(norms - 1.0).argmax())
            raise TrajectoryRefused(f"quaternion of sample {k} has norm {norms[k]:.3f}, not 1")
    if len(steps) and steps.max() > gap:
        k = int(steps.argmax())
        raise TrajectoryRefused(f"position jumps by {steps[k]:.3f} m at {places[k]:.3f} s; at most {gap:g} m is allowed")
    if len(kinks) and kinks.max() > 10.0 * gap:
        k = int(kinks.argmax())
        raise TrajectoryRefused(f"velocity jumps by {kinks[k]:.3f} m/s at {places[k]:.3f} s; at most {10 * gap:g} m/s is allowed")


def check_start(order: Order, now: float, present: Setpoint, settings: FlightSettings) -> None:
    """Refuse a trajectory that does not begin where and when the vehicle is.

    Args:
        order: what to check.
        now: time of the step [s].
        present: where the vehicle will be at the start: the running reference there, or the state.
        settings: gaps that are allowed.

    Raises:
        TrajectoryRefused: with the gap and its limit.
    """
    late = now - order.start
    if late > settings.start_late:
        raise TrajectoryRefused(f"starts {late:.2f} s in the past; at most {settings.start_late:g} s is allowed")
    begin = order.source.setpoint(max(late, 0.0))
    gap = float(np.linalg.norm(np.subtract(begin.p, present.p)))
    if gap > settings.start_gap:
        raise TrajectoryRefused(f"starts {gap:.2f} m away from the vehicle; at most {settings.start_gap:g} m is allowed")
    speed = float(np.linalg.norm(np.subtract(begin.v, present.v)))
    if speed > settings.start_speed_gap:
        raise TrajectoryRefused(f"starts {speed:.2f} m/s from the vehicle's velocity; at most {settings.start_speed_gap:g} m/s is allowed")
