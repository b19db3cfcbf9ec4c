"""Differential flatness of a multirotor: position and yaw with their derivatives give attitude, rates and thrust."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import numpy as np

from perch_core.arrays import Array, Numbers, Vector3
from perch_core.errors import FreeFallError
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, dot, norm, scale
from perch_core.vehicle import GRAVITY

_SPECIFIC_THRUST_FLOOR = 1e-6  # [m/s^2] below this the direction of the thrust is rounding noise
_HEADING_FLOOR = 1e-6          # sine of the angle between b3 and b2_des below which b1 is undefined


class HeadingError(FreeFallError):
    """Raised when the thrust is parallel to b2_des, so that the yaw reference defines no b1. [M:eq12]"""


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
    """

    p_WB: Array
    R_WB: Array
    v_WB: Array
    w_WB_B: Array
    dw_WB_B: Array
    thrust: float


@compiled(inline=True)
def direction_derivatives(f: Numbers, df: Numbers, ddf: Numbers) -> tuple[Vector3, Vector3, Vector3]:
    """Return the unit vector along f with its first and second derivative."""
    k = 1.0 / norm(f)
    u = scale(k, f)
    dn = dot(u, df)
    du = scale(k, axpy(-dn, u, df))
    ddn = dot(du, df) + dot(u, ddf)
    ddu = scale(k, axpy(-2.0 * dn, du, axpy(-ddn, u, ddf)))
    return u, du, ddu


@compiled(inline=True)
def turned_heading(sy: float, cy: float, yaw_rate: float, yaw_acc: float) -> tuple[Vector3, Vector3, Vector3]:
    """b2_des = (-sin yaw, cos yaw, 0) with its first and second derivative, given sine and cosine of the yaw. [M:eq12]"""
    return ((-sy, cy, 0.0), (-cy * yaw_rate, -sy * yaw_rate, 0.0),
            (sy * yaw_rate * yaw_rate - cy * yaw_acc, -cy * yaw_rate * yaw_rate - sy * yaw_acc, 0.0))


@compiled
def heading_derivatives(yaw: float, yaw_rate: float, yaw_acc: float) -> tuple[Vector3, Vector3, Vector3]:
    """b2_des with its first and second derivative. [M:eq12]"""
    return turned_heading(sin(yaw), cos(yaw), yaw_rate, yaw_acc)


@compiled(inline=True)
def commanded_frame(f: Numbers, df: Numbers, ddf: Numbers, h: Numbers, dh: Numbers, ddh: Numbers
                    ) -> tuple[Vector3, Vector3, Vector3, Vector3, Vector3]:
    """Commanded attitude, body rates and angular accelerations for force and heading vectors. [defines M:eq10, M:eq12, M:eq13]

    Args:
        f, df, ddf: specific force and its derivatives, |f| > 0.
        h, dh, ddh: desired direction of b2 (b2_des) and its derivatives; not parallel to f.

    Returns:
        b1, b2, b3 (columns of R_C), w_C and dw_C in the commanded frame [rad/s, rad/s^2].
    """
    b3, db3, ddb3 = direction_derivatives(f, df, ddf)
    n = cross(h, b3)
    dn = axpy(1.0, cross(dh, b3), cross(h, db3))
    ddn = axpy(1.0, cross(ddh, b3), axpy(2.0, cross(dh, db3), cross(h, ddb3)))
    b1, db1, ddb1 = direction_derivatives(n, dn, ddn)
    b2 = cross(b3, b1)
    # R' = R hat(w): the body components of b3' are (wy, -wx, 0), those of b1' are (0, wz, -wy). [M:eq13]
    wx, wy, wz = -dot(b2, db3), dot(b1, db3), dot(b2, db1)
    # R'' = R (hat(w)^2 + hat(w')); hat(w)^2 e = w (w . e) - e |w|^2.
    dwx = -dot(b2, ddb3) + wy * wz
    dwy = dot(b1, ddb3) - wx * wz
    dwz = dot(b2, ddb1) - wx * wy
    return b1, b2, b3, (wx, wy, wz), (dwx, dwy, dwz)


def attitude(b3_W: Array, yaw: float) -> Array:
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
    n = cross((-sin(yaw), cos(yaw), 0.0), b3)
    if not norm(n) > _HEADING_FLOOR:
        raise HeadingError(f"thrust direction {b3} is parallel to b2_des of yaw {yaw:g} rad")
    b1 = scale(1.0 / norm(n), n)
    return np.array([b1, cross(b3, b1), b3]).T


def flat_to_state(p: Numbers, v: Numbers, a: Numbers, j: Numbers, s: Numbers, yaw: float, yaw_rate: float, yaw_acc: float, mass: float) -> FlatState:
    """State, body rates, angular accelerations and thrust for given flat outputs. [M:eq9-13]

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
        HeadingError: the thrust is parallel to b2_des [M:eq12].
    """
    j, s = (float(j[0]), float(j[1]), float(j[2])), (float(s[0]), float(s[1]), float(s[2]))
    f = (float(a[0]), float(a[1]), float(a[2]) + GRAVITY)
    specific = norm(f)
    if not specific > _SPECIFIC_THRUST_FLOOR:
        raise FreeFallError(f"specific thrust {specific:g} m/s^2 at acceleration {a}: no thrust direction")
    h, dh, ddh = heading_derivatives(float(yaw), float(yaw_rate), float(yaw_acc))
    if not norm(cross(h, f)) > _HEADING_FLOOR * specific:
        raise HeadingError(f"thrust direction {scale(1.0 / specific, f)} is parallel to b2_des of yaw {yaw:g} rad")
    b1, b2, b3, w, dw = commanded_frame(f, j, s, h, dh, ddh)
    return FlatState(
        p_WB=np.asarray(p, float),
        R_WB=np.array(((b1[0], b2[0], b3[0]), (b1[1], b2[1], b3[1]), (b1[2], b2[2], b3[2]))),
        v_WB=np.asarray(v, float),
        w_WB_B=np.array(w),
        dw_WB_B=np.array(dw),
        thrust=mass * specific,
    )
