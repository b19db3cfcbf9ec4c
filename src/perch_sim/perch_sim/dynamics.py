"""Compiled kernels of the plant: rigid body, rotors, contact forces, one Runge-Kutta step.

These equations are used by the simulator only; a test compares them with plain numpy (tests/oracles/rigid_body.py). They are
written in scalars: numba needs about 1 us for a step, numpy 200 us.

State `x` (13): p_WB (3) [m], q_WB (4, xyzw), v_WB (3) [m/s], w_WB_B (3) [rad/s]. Rotor speeds (4) [rad/s] are separate,
as their lag has an exact solution.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_sim.body import PLATE_POINTS, Body
from perch_sim.obstacles import Surfaces

STATES = 13
SLIDING_SPEED = 0.02   # below it friction fades out, so that a resting vehicle stays quiet [m/s]
EFFECT_HEIGHT = 0.5    # ground effect is evaluated no nearer than this many rotor radii
NO_CONTACT = 1e3       # clearance of what is out of reach [m]


class Hold(NamedTuple):
    """Hold of the plate or the gripper: a point and an attitude, to which stiff springs pull the body."""

    active: bool
    surface: int          # row of the surface that holds, -1: none of them
    anchor_W: np.ndarray  # where the plate's centre is held, (3,) [m]
    velocity: np.ndarray  # of the anchor, (3,) [m/s]
    attitude: np.ndarray  # q_WB at which the body is held, (4,)


@compiled
def rotation(q: np.ndarray) -> np.ndarray:
    """Return R_WB of a unit quaternion xyzw, (3, 3)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return R


@compiled
def _point_velocity(x: np.ndarray, R: np.ndarray, r: np.ndarray, out: np.ndarray) -> None:
    """Compute the velocity in W of the body point r_B: v + R (w x r), written to `out`."""
    a = x[11] * r[2] - x[12] * r[1]
    b = x[12] * r[0] - x[10] * r[2]
    c = x[10] * r[1] - x[11] * r[0]
    for i in range(3):
        out[i] = x[7 + i] + R[i, 0] * a + R[i, 1] * b + R[i, 2] * c


@compiled
def _add_force(R: np.ndarray, r: np.ndarray, f_W: np.ndarray, force_W: np.ndarray, torque_B: np.ndarray) -> None:
    """Add a force in W that acts at the body point r_B."""
    fx = R[0, 0] * f_W[0] + R[1, 0] * f_W[1] + R[2, 0] * f_W[2]
    fy = R[0, 1] * f_W[0] + R[1, 1] * f_W[1] + R[2, 1] * f_W[2]
    fz = R[0, 2] * f_W[0] + R[1, 2] * f_W[1] + R[2, 2] * f_W[2]
    for i in range(3):
        force_W[i] += f_W[i]
    torque_B[0] += r[1] * fz - r[2] * fy
    torque_B[1] += r[2] * fx - r[0] * fz
    torque_B[2] += r[0] * fy - r[1] * fx


@compiled
def _depth(s: int, point_W: np.ndarray, surfaces: Surfaces, time: float) -> float:
    """Return the signed distance of a point from surface `s` [m]; NO_CONTACT beside its rectangle or behind it.

    A point behind the rectangle is beside it where it is nearer to the border: another face of the same box is then nearest.
    """
    d0 = point_W[0] - surfaces.origin[s, 0] - surfaces.velocity[s, 0] * time
    d1 = point_W[1] - surfaces.origin[s, 1] - surfaces.velocity[s, 1] * time
    d2 = point_W[2] - surfaces.origin[s, 2] - surfaces.velocity[s, 2] * time
    A = surfaces.axes[s]
    z = d0 * A[0, 2] + d1 * A[1, 2] + d2 * A[2, 2]
    inside = min(z, 0.0)
    if abs(d0 * A[0, 0] + d1 * A[1, 0] + d2 * A[2, 0]) > surfaces.half_size[s, 0] + inside:
        return NO_CONTACT
    if abs(d0 * A[0, 1] + d1 * A[1, 1] + d2 * A[2, 1]) > surfaces.half_size[s, 1] + inside:
        return NO_CONTACT
    return z if z > -surfaces.depth[s] else NO_CONTACT


@compiled
def _near(s: int, x: np.ndarray, surfaces: Surfaces, time: float, reach: float) -> bool:
    """Return whether a point within `reach` of the centre of mass can be inside surface `s`."""
    z = 0.0
    for i in range(3):
        z += (x[i] - surfaces.origin[s, i] - surfaces.velocity[s, i] * time) * surfaces.axes[s, i, 2]
    return -surfaces.depth[s] - reach < z < reach


@compiled
def _contact_forces(x: np.ndarray, R: np.ndarray, body: Body, surfaces: Surfaces, hold: Hold, time: float,
                    force_W: np.ndarray, torque_B: np.ndarray) -> None:
    """Add the forces of springs, dampers and friction at the contact points that are inside a surface."""
    for s in range(surfaces.origin.shape[0]):
        if not _near(s, x, surfaces, time, body.reach):
            continue
        point, velocity, f = np.empty(3), np.empty(3), np.empty(3)
        for k in range(body.points.shape[0]):
            if hold.active and hold.surface == s and k < PLATE_POINTS:
                continue  # the velcro's own springs act there
            r = body.points[k]
            for i in range(3):
                point[i] = x[i] + R[i, 0] * r[0] + R[i, 1] * r[1] + R[i, 2] * r[2]
            z = _depth(s, point, surfaces, time)
            if z >= 0.0:
                continue
            _point_velocity(x, R, r, velocity)
            normal = 0.0
            for i in range(3):
                velocity[i] -= surfaces.velocity[s, i]
                normal += velocity[i] * surfaces.axes[s, i, 2]
            pressure = -body.stiffness[k] * z - body.damping[k] * normal
            if pressure <= 0.0:
                continue  # a surface pushes, it does not pull
            square = 0.0
            for i in range(3):
                velocity[i] -= normal * surfaces.axes[s, i, 2]
                square += velocity[i] * velocity[i]
            rub = body.friction * pressure / math.sqrt(square + SLIDING_SPEED * SLIDING_SPEED)
            for i in range(3):
                f[i] = pressure * surfaces.axes[s, i, 2] - rub * velocity[i]
            _add_force(R, r, f, force_W, torque_B)


@compiled
def _hold_forces(x: np.ndarray, R: np.ndarray, body: Body, hold: Hold,
                 force_W: np.ndarray, torque_B: np.ndarray) -> None:
    """Add the forces of springs and dampers between an attached plate or gripper and its hold."""
    r, velocity, f = np.zeros(3), np.empty(3), np.empty(3)
    r[2] = -body.plate_offset
    _point_velocity(x, R, r, velocity)
    for i in range(3):
        stretch = x[i] + R[i, 2] * r[2] - hold.anchor_W[i]
        f[i] = -body.hold[0] * stretch - body.hold[1] * (velocity[i] - hold.velocity[i])
    _add_force(R, r, f, force_W, torque_B)
    # Rotation error in B: vector part of conj(q_hold) * q, doubled, on the short way round.
    a, q = hold.attitude, x[3:7]
    ew = a[3] * q[3] + a[0] * q[0] + a[1] * q[1] + a[2] * q[2]
    sign = 2.0 if ew >= 0.0 else -2.0
    e0 = a[3] * q[0] - a[0] * q[3] - a[1] * q[2] + a[2] * q[1]
    e1 = a[3] * q[1] + a[0] * q[2] - a[1] * q[3] - a[2] * q[0]
    e2 = a[3] * q[2] - a[0] * q[1] + a[1] * q[0] - a[2] * q[3]
    torque_B[0] -= body.hold[2] * sign * e0 + body.hold[3] * x[10]
    torque_B[1] -= body.hold[2] * sign * e1 + body.hold[3] * x[11]
    torque_B[2] -= body.hold[2] * sign * e2 + body.hold[3] * x[12]


@compiled
def _effect(x: np.ndarray, R: np.ndarray, xy: np.ndarray, body: Body, surfaces: Surfaces, time: float) -> float:
    """Return the thrust gain of a rotor near a surface: 1 / (1 - (R / 4z)^2), by Cheeseman and Bennett."""
    gain, point = 1.0, np.empty(3)
    for s in range(surfaces.origin.shape[0]):
        facing = 0.0
        for i in range(3):
            point[i] = x[i] + R[i, 0] * xy[0] + R[i, 1] * xy[1]
            facing += R[i, 2] * surfaces.axes[s, i, 2]
        z = _depth(s, point, surfaces, time)
        if facing > 0.0 and z < 10 * body.rotor_radius:
            ratio = body.rotor_radius / (4 * max(z, EFFECT_HEIGHT * body.rotor_radius))
            gain += (1 / (1 - ratio * ratio) - 1) * facing * facing
    return gain


@compiled
def derivative(x: np.ndarray, speeds: np.ndarray, wind: np.ndarray, body: Body, surfaces: Surfaces, hold: Hold,
               time: float, out: np.ndarray) -> None:
    """Compute the time derivative of the state, written to `out` (13,). [M:eq1]

    Args:
        x: state (13,).
        speeds: rotor speeds (4,) [rad/s].
        wind: air velocity in W (3,) [m/s].
        body, surfaces, hold: see `Body`, `Surfaces`, `Hold`.
        time: time [s], for surfaces that move.
        out: set to p', q', v', w'.
    """
    R = rotation(x[3:7])
    force_W, torque = np.zeros(3), np.zeros(3)
    thrust = 0.0
    for k in range(4):
        f = body.thrust_coefficient[k] * speeds[k] * speeds[k]
        if body.surface_effect:
            f *= _effect(x, R, body.rotor_xy[k], body, surfaces, time)
        thrust += f
        torque[0] += body.rotor_xy[k, 1] * f
        torque[1] -= body.rotor_xy[k, 0] * f
        torque[2] += body.yaw_arm[k] * f
    for j in range(3):  # rotor drag, along each body axis
        airspeed = 0.0
        for i in range(3):
            airspeed += R[i, j] * (x[7 + i] - wind[i])
        along = (thrust if j == 2 else 0.0) - body.drag[j] * airspeed
        for i in range(3):
            force_W[i] += R[i, j] * along
    _contact_forces(x, R, body, surfaces, hold, time, force_W, torque)
    if hold.active:
        _hold_forces(x, R, body, hold, force_W, torque)
    wx, wy, wz = x[10], x[11], x[12]
    qx, qy, qz, qw = x[3], x[4], x[5], x[6]
    for i in range(3):
        out[i] = x[7 + i]
        out[7 + i] = force_W[i] / body.mass
    out[9] -= GRAVITY
    out[3] = 0.5 * (qw * wx + qy * wz - qz * wy)
    out[4] = 0.5 * (qw * wy + qz * wx - qx * wz)
    out[5] = 0.5 * (qw * wz + qx * wy - qy * wx)
    out[6] = -0.5 * (qx * wx + qy * wy + qz * wz)
    J = body.inertia
    out[10] = (torque[0] - (J[2] - J[1]) * wy * wz) / J[0]
    out[11] = (torque[1] - (J[0] - J[2]) * wz * wx) / J[1]
    out[12] = (torque[2] - (J[1] - J[0]) * wx * wy) / J[2]


@compiled
def lagged(speeds: np.ndarray, command: np.ndarray, time_constant: float, step: float) -> np.ndarray:
    """Return the rotor speeds after `step` seconds of a constant command: the exact first-order lag, (4,)."""
    fade = math.exp(-step / time_constant) if time_constant > 0.0 else 0.0
    return command + (speeds - command) * fade


@compiled
def advance(x: np.ndarray, speeds: np.ndarray, command: np.ndarray, wind: np.ndarray, body: Body, surfaces: Surfaces,
            hold: Hold, time: float, step: float, inertial: np.ndarray) -> None:
    """Advance one Runge-Kutta step of fourth order; `x` and `speeds` are overwritten, the quaternion normalised.

    Args:
        command: target speeds of the rotors (4,) [rad/s].
        time: time at the start of the step [s].
        step: duration [s].
        inertial: set to the mean specific force and the mean angular velocity at the IMU in B over the step, (6,).
    """
    before = x.copy()
    k1, k2, k3, k4 = np.empty(13), np.empty(13), np.empty(13), np.empty(13)
    middle = lagged(speeds, command, body.time_constant, 0.5 * step)
    end = lagged(speeds, command, body.time_constant, step)
    derivative(x, speeds, wind, body, surfaces, hold, time, k1)
    derivative(before + 0.5 * step * k1, middle, wind, body, surfaces, hold, time + 0.5 * step, k2)
    half = before + 0.5 * step * k2
    derivative(half, middle, wind, body, surfaces, hold, time + 0.5 * step, k3)
    derivative(before + step * k3, end, wind, body, surfaces, hold, time + step, k4)
    for i in range(13):
        x[i] = before[i] + step / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i])
    norm = math.sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5] + x[6] * x[6])
    for i in range(3, 7):
        x[i] /= norm
    for k in range(4):
        speeds[k] = end[k]
    # The IMU integrates: its mean specific force is the velocity gained, so that no shock falls between two samples.
    R, r = rotation(half[3:7]), body.imu_position
    wx, wy, wz = half[10], half[11], half[12]
    ax, ay, az = (x[10] - before[10]) / step, (x[11] - before[11]) / step, (x[12] - before[12]) / step
    for i in range(3):
        inertial[i] = 0.0
        for j in range(3):
            inertial[i] += R[j, i] * ((x[7 + j] - before[7 + j]) / step + (GRAVITY if j == 2 else 0.0))
        inertial[3 + i] = 0.5 * (x[10 + i] + before[10 + i])
    spin = wx * r[0] + wy * r[1] + wz * r[2]
    square = wx * wx + wy * wy + wz * wz
    inertial[0] += ay * r[2] - az * r[1] + wx * spin - square * r[0]
    inertial[1] += az * r[0] - ax * r[2] + wy * spin - square * r[1]
    inertial[2] += ax * r[1] - ay * r[0] + wz * spin - square * r[2]


@compiled
def clearances(x: np.ndarray, before: np.ndarray, body: Body, surfaces: Surfaces, time: float, out: np.ndarray) -> float:
    """Compute the clearances of each surface, written to `out` (m, 3).

    Its columns are the smallest distances of the plate and of all other points [m], and the greatest speed into the surface of
    a point that is inside [m/s], one step earlier: an impact is classified by the state before its forces act.

    Args:
        x, before: state, and that one step earlier (13,).

    Returns:
        The smallest distance of all [m]; NO_CONTACT if no surface is in reach.
    """
    R, point, velocity, least = rotation(x[3:7]), np.empty(3), np.empty(3), NO_CONTACT
    R_before = rotation(before[3:7])
    for s in range(surfaces.origin.shape[0]):
        out[s, 0] = out[s, 1] = NO_CONTACT
        out[s, 2] = 0.0
        if not _near(s, x, surfaces, time, body.reach):
            continue
        for k in range(body.points.shape[0]):
            r = body.points[k]
            for i in range(3):
                point[i] = x[i] + R[i, 0] * r[0] + R[i, 1] * r[1] + R[i, 2] * r[2]
            part, z = 0 if k < PLATE_POINTS else 1, _depth(s, point, surfaces, time)
            out[s, part] = min(out[s, part], z)
            if z < 0.0:
                _point_velocity(before, R_before, r, velocity)
                into = 0.0
                for i in range(3):
                    into += (surfaces.velocity[s, i] - velocity[i]) * surfaces.axes[s, i, 2]
                out[s, 2] = max(out[s, 2], into)
        least = min(least, out[s, 0], out[s, 1])
    return least


@compiled
def advance_to_touch(x: np.ndarray, speeds: np.ndarray, command: np.ndarray, wind: np.ndarray, body: Body,
                     surfaces: Surfaces, hold: Hold, time: float, step: float, path: np.ndarray, inertial: np.ndarray,
                     touched: np.ndarray) -> tuple[int, bool]:
    """Make steps of `advance` until a surface is touched: one call per control period in free flight.

    Args:
        path: set to the state after each step (n, 13); n is the greatest number of steps.
        inertial: sum to which `inertial` of `advance` is added in each step, (6,).
        touched: set to the clearances after the last step, as `out` of `clearances`.

    Returns:
        Number of steps, and whether a surface is touched after the last one.
    """
    sample, before = np.empty(6), np.empty(13)
    for k in range(path.shape[0]):
        before[:] = x
        advance(x, speeds, command, wind, body, surfaces, hold, time + k * step, step, sample)
        for i in range(6):
            inertial[i] += sample[i]
        path[k] = x
        if clearances(x, before, body, surfaces, time + (k + 1) * step, touched) <= 0.0:
            return k + 1, True
    return path.shape[0], False
