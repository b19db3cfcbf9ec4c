"""The controller flown on the model before it flies: where will it end?

Near contact the thrust is low, and so is the moment that the rotors have without extra thrust: with their lag, or with a
plan that asks for more, stopping the rotation pushes the vehicle away from the wall by up to 0.3 m/s, every time, in the
same way. No feedback can undo that in the last tenth of a second, but it can be known beforehand: the flight is rehearsed with
rotor lag and limits, and the reference is offset so that the *rehearsed* vehicle arrives as planned.
"""

from __future__ import annotations

from math import exp

import numpy as np

from perch_core.flatness import commanded_frame
from perch_core.jit import compiled
from perch_core.vector3 import quaternion_of
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.geometric.step import control_step, drag_compensation, predicted
from perch_control.guidance import Blend, Polynomial, Running
from perch_control.reference import Setpoint, packed_many
from perch_control.rotor_lag import RotorEstimate, approached, thrusts

_ROUNDS = 5
_SPAN = 1.5     # the last part of the trajectory is rehearsed [s]
_QUIET = 0.3    # the offset no longer accelerates: the rotation at the end [s]
_POSITION_SCALE, _SPEED_SCALE = 0.05, 0.2  # misses that weigh the same [m], [m/s]
_CLOSE = 0.1    # the sum of both, with which the rounds end
_LARGEST = 0.5  # an offset beyond this belongs to the planner [m, m/s]


@compiled
def flown(start, speed, table, gains, limits, narrow, window, lead, period, duration, vehicle):
    """State at the end of a flight of the geometric controller on the nominal vehicle; see `rehearse`."""
    state, command = start, speed
    mass, J = vehicle[0][0], vehicle[0][1:4]
    coefficient, _, _, tau = vehicle[1]
    share = 1.0 if tau <= 0.0 else 1.0 - exp(-period / tau)
    middle = 1.0 if tau <= 0.0 else 1.0 - exp(-0.5 * period / tau)
    none = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(table.shape[0]):
        r = table[k]
        reference = (r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11], r[12], r[13], r[14], r[15],
                     r[16], r[17], r[18], r[19], r[20], r[21], r[22], r[23],
                     r[24], r[25], r[26], r[27], r[28], r[29], r[30], r[31], r[32])
        part = 1.0 if window <= 0.0 else min(max((duration - k * period - lead) / window, 0.0), 1.0)
        cone = narrow + part * (limits[1] - narrow)
        command = control_step(state, reference, speed, command, none, gains,
                               (limits[0], cone, limits[2], limits[3], limits[4], limits[5]), lead, vehicle)[0]
        f = thrusts(approached(speed, command, middle), coefficient)
        felt = drag_compensation(state[6:10], state[3:6], vehicle[4], none)
        state = predicted(state, f, felt, period, mass, J, vehicle[2])
        speed = approached(speed, command, share)
    return np.array(state)


def rehearsed(source, vehicle: Vehicle, controller, contact_speed: float, overshoot: float, running: Running | None = None):
    """A contact trajectory, offset so that the controller arrives where and as fast as planned.

    The offset grows while the thrust is still high and goes on as a straight line through the rotation at the end, which
    therefore stays as it was rehearsed: what is added to the end's position and velocity arrives there nearly unchanged,
    and a few rounds converge. A trajectory that continues one that was rehearsed (a new plan in flight) begins with the offset
    that is flown by then: it is not taken back first, and the new rehearsal starts from there.

    Args:
        source: reference with `duration` and `setpoint(t)`.
        vehicle: the nominal vehicle.
        controller: a `GeometricController`.
        contact_speed: least speed into the surface at the contact [m/s]; a slower plan arrives with this.
        overshoot: the end lies so far behind the surface [m]: a vehicle that estimation errors hold back touches it, too.
        running: reference from which the trajectory takes over; None: the vehicle is where the trajectory begins.

    Returns:
        The reference to follow; `source` itself where it is too short, or where the rehearsal comes no closer.
    """
    T, period = source.duration, controller.period
    first = np.zeros((4, 3)) if running is None else _apart(running.setpoint, source.setpoint(0.0))
    taken = running if first.any() else None
    n = int((min(_SPAN, T) if taken is None else T) / period)
    growth = n * period - _QUIET
    if growth < _QUIET:
        return source
    begin, lead = (T - n * period if taken is None else 0.0), controller.lead
    times = np.arange(n) * period + lead
    table = packed_many(source, begin + times)
    start, rotors = _on_reference(source.setpoint(begin) if taken is None else taken.setpoint, vehicle)
    end = source.setpoint(T)
    s3 = np.add(end.a, (0.0, 0.0, GRAVITY)) / np.linalg.norm(np.add(end.a, (0.0, 0.0, GRAVITY)))
    faster = max(contact_speed + float(np.dot(end.v, s3)), 0.0)
    wanted = np.array([np.subtract(end.p, overshoot * s3), np.subtract(end.v, faster * s3)])
    delta = np.zeros((2, 3)) if taken is None else taken.carried
    best, least = delta, np.inf
    for _ in range(_ROUNDS):
        shifted = table.copy()
        shifted[:, :15] += _offset(delta, growth, first).many(times)[:, :15]
        final = controller.rehearse(start, rotors, shifted, period, n * period)
        miss = np.array([final[0:3], final[3:6]]) - wanted
        error = float(np.linalg.norm(miss[0]) / _POSITION_SCALE + np.linalg.norm(miss[1]) / _SPEED_SCALE)
        if error < least:
            best, least = delta.copy(), error
        if error < _CLOSE:
            break
        delta = np.clip(delta - miss, -_LARGEST, _LARGEST)
    return Blend(source, begin, _offset(best, growth, first), lasting=True) if best.any() or taken is not None else source


def _apart(running: Setpoint, start: Setpoint) -> np.ndarray:
    """What the running reference has beyond a trajectory's start: position and three derivatives, shape (4, 3); zero where
    that is rounding."""
    gap = np.array([np.subtract(getattr(running, k), getattr(start, k)) for k in ("p", "v", "a", "j")])
    return gap if np.abs(gap[:3]).max() > 1e-6 else np.zeros((4, 3))


def _offset(delta: np.ndarray, duration: float, first: np.ndarray) -> Polynomial:
    """From `first` (offset and three derivatives) onto the line that has offset `delta` (position, velocity) `_QUIET` later.

    Bernstein coefficients of degree 7, from both ends; on the line nothing accelerates.
    """
    T, (p0, v0, a0, j0) = duration, first
    p, v = delta[0] - _QUIET * delta[1], delta[1] * T / 7.0
    points = np.stack([
        p0, p0 + v0 * T / 7, p0 + 2 * v0 * T / 7 + a0 * T**2 / 42, p0 + 3 * v0 * T / 7 + 3 * a0 * T**2 / 42 + j0 * T**3 / 210,
        p - 3.0 * v, p - 2.0 * v, p - v, p], axis=-1)
    return Polynomial(points, duration, (0.0, 0.0, 0.0))


def _on_reference(x, vehicle: Vehicle) -> tuple[np.ndarray, RotorEstimate]:
    """State and rotors of a vehicle that is exactly on a setpoint."""
    f = (x.a[0], x.a[1], x.a[2] + GRAVITY)
    b1, b2, b3, w, _ = commanded_frame(f, x.j, x.s, x.h, x.dh, x.ddh)
    speed = float(np.sqrt(vehicle.mass * np.linalg.norm(f) / 4.0 / vehicle.thrust_coefficient))
    return np.array([*x.p, *x.v, *quaternion_of(b1, b2, b3), *w]), RotorEstimate((speed,) * 4, (speed,) * 4)
