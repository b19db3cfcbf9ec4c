"""Differential flatness of a multirotor: position and yaw with their derivatives give attitude, rates and thrust."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt

import numpy as np

from perch_core.errors import FreeFallError
from perch_core.vehicle import GRAVITY

_SPECIFIC_THRUST_FLOOR = 1e-6  # [m/s^2] below this the direction of the thrust is rounding noise
_HEADING_FLOOR = 1e-6          # sine of the angle between b3 and b2_des below which b1 is undefined


class HeadingError(FreeFallError):
    """The thrust points along b2_des, so that the yaw reference defines no b1. [M:eq12]"""


@dataclass(frozen=True, slots=True)
class FlatState:
    """Full state and inputs that follow from the flat outputs.

    Attributes:
        p_WB: position of the centre of mass in W [m], shape (3,).
        R_WB: attitude, columns b1, b2, b3 in W, shape (3, 3).
        v_WB: velocity in W [m/s], shape (3,).
        w_WB_B: angular velocity in B [rad/s], shape (3,).
        dw_WB_B: angular acceleration in B [rad/s^2], shape (3,).
        thrust: collective thrust along b3 [N].
        thrust_rate: its time derivative [N/s].
    """

    p_WB: np.ndarray
    R_WB: np.ndarray
    v_WB: np.ndarray
    w_WB_B: np.ndarray
    dw_WB_B: np.ndarray
    thrust: float
    thrust_rate: float


# Tuples of floats: a call costs 9 us, against 250 us for the same lines on small numpy arrays.
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _add(a, b):
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _unit_and_derivatives(f, df, ddf, norm):
    """Direction u = f / |f| with its first two derivatives, and the first derivative of |f|."""
    k = 1.0 / norm
    u = (f[0] * k, f[1] * k, f[2] * k)
    dn = _dot(u, df)
    du = ((df[0] - dn * u[0]) * k, (df[1] - dn * u[1]) * k, (df[2] - dn * u[2]) * k)
    ddn = _dot(du, df) + _dot(u, ddf)
    ddu = ((ddf[0] - 2.0 * dn * du[0] - ddn * u[0]) * k, (ddf[1] - 2.0 * dn * du[1] - ddn * u[1]) * k,
           (ddf[2] - 2.0 * dn * du[2] - ddn * u[2]) * k)
    return u, du, ddu, dn


def thrust_direction(a_W: np.ndarray) -> np.ndarray:
    """Body z axis that flatness demands for an acceleration. [M:eq10]

    Args:
        a_W: acceleration of the centre of mass in W [m/s^2], shape (3,).

    Returns:
        Unit vector b3 in W, shape (3,).

    Raises:
        FreeFallError: where `a_W + g e3` vanishes and no direction is defined.
    """
    f = np.asarray(a_W, float) + (0.0, 0.0, GRAVITY)
    norm = float(np.linalg.norm(f))
    if not norm > _SPECIFIC_THRUST_FLOOR:
        raise FreeFallError(f"specific thrust {norm:g} m/s^2 at acceleration {np.asarray(a_W)}: no thrust direction")
    return f / norm


def attitude(b3_W: np.ndarray, yaw: float) -> np.ndarray:
    """Attitude from a thrust direction and a yaw angle. [M:eq12]

    `b1 = (b2_des x b3) / |b2_des x b3|`, `b2 = b3 x b1`, `b2_des = (-sin yaw, cos yaw, 0)`.

    Args:
        b3_W: unit vector, shape (3,).
        yaw: heading [rad].

    Returns:
        R_WB, shape (3, 3).

    Raises:
        HeadingError: b3 is parallel to b2_des.
    """
    b3 = tuple(float(x) for x in b3_W)
    n = _cross((-sin(yaw), cos(yaw), 0.0), b3)
    norm = sqrt(_dot(n, n))
    if not norm > _HEADING_FLOOR:
        raise HeadingError(f"thrust direction {b3} is parallel to b2_des of yaw {yaw:g} rad")
    b1 = (n[0] / norm, n[1] / norm, n[2] / norm)
    return np.array([b1, _cross(b3, b1), b3]).T


def flat_to_state(p, v, a, j, s, yaw: float, yaw_rate: float, yaw_acc: float, mass: float) -> FlatState:
    """State, body rates, angular accelerations and thrust of the flat outputs. [M:eq9-13]

    Args:
        p: position in W [m], shape (3,).
        v: velocity in W [m/s], shape (3,).
        a: acceleration in W [m/s^2], shape (3,).
        j: jerk in W [m/s^3], shape (3,).
        s: snap in W [m/s^4], shape (3,).
        yaw: heading, b2_des = (-sin yaw, cos yaw, 0) [rad].
        yaw_rate: [rad/s].
        yaw_acc: [rad/s^2].
        mass: vehicle mass [kg].

    Returns:
        The full state; see `FlatState`.

    Raises:
        FreeFallError: the specific thrust vanishes [M:eq10].
        HeadingError: the thrust points along b2_des [M:eq12].
    """
    j, s = (float(j[0]), float(j[1]), float(j[2])), (float(s[0]), float(s[1]), float(s[2]))
    f = (float(a[0]), float(a[1]), float(a[2]) + GRAVITY)
    specific = sqrt(_dot(f, f))
    if not specific > _SPECIFIC_THRUST_FLOOR:
        raise FreeFallError(f"specific thrust {specific:g} m/s^2 at acceleration {a}: no thrust direction")
    b3, db3, ddb3, specific_rate = _unit_and_derivatives(f, j, s, specific)

    sy, cy = sin(yaw), cos(yaw)
    d = (-sy, cy, 0.0)
    dd = (-cy * yaw_rate, -sy * yaw_rate, 0.0)
    ddd = (sy * yaw_rate**2 - cy * yaw_acc, -cy * yaw_rate**2 - sy * yaw_acc, 0.0)
    n = _cross(d, b3)
    norm = sqrt(_dot(n, n))
    if not norm > _HEADING_FLOOR:
        raise HeadingError(f"thrust direction {b3} is parallel to b2_des of yaw {yaw:g} rad")
    dn = _add(_cross(dd, b3), _cross(d, db3))
    two_cross = _cross(dd, db3)
    ddn = _add(_add(_cross(ddd, b3), _cross(d, ddb3)), _add(two_cross, two_cross))
    b1, db1, ddb1, _ = _unit_and_derivatives(n, dn, ddn, norm)
    b2 = _cross(b3, b1)

    # R' = R hat(w): the body components of b3' are (wy, -wx, 0), those of b1' are (0, wz, -wy). [M:eq13]
    wx, wy, wz = -_dot(b2, db3), _dot(b1, db3), _dot(b2, db1)
    # R'' = R (hat(w)^2 + hat(w')); hat(w)^2 e = w (w . e) - e |w|^2.
    dwx = -_dot(b2, ddb3) + wy * wz
    dwy = _dot(b1, ddb3) - wx * wz
    dwz = _dot(b2, ddb1) - wx * wy
    return FlatState(
        p_WB=np.asarray(p, float),
        R_WB=np.array(((b1[0], b2[0], b3[0]), (b1[1], b2[1], b3[1]), (b1[2], b2[2], b3[2]))),
        v_WB=np.asarray(v, float),
        w_WB_B=np.array((wx, wy, wz)),
        dw_WB_B=np.array((dwx, dwy, dwz)),
        thrust=mass * specific,
        thrust_rate=mass * specific_rate,
    )
