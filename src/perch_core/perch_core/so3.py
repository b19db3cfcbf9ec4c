"""Rotations: SO(3) and unit quaternions (xyzw), for single values and for arrays with leading axes.

Conventions: `R_AB` takes vectors from B to A; `exp` maps a rotation vector [rad] to the active rotation;
quaternions are Hamilton, stored x, y, z, w, and `q` and `-q` are the same rotation.
"""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array

_SMALL = 1e-6  # below this angle the series are exact to double precision


def hat(v: Array) -> Array:
    """Skew matrix with `hat(a) @ b = a x b`. [M:eq1]

    Args:
        v: vectors, shape (..., 3).

    Returns:
        Matrices, shape (..., 3, 3).
    """
    v = np.asarray(v, float)
    out = np.zeros(v.shape[:-1] + (3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _sinc_terms(angle: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3, by series near zero."""
    small = angle < _SMALL
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    return (
        np.where(small, 1 - a2 / 6, np.sin(a) / a),
        np.where(small, 0.5 - a2 / 24, 0.5 * (np.sin(0.5 * a) / (0.5 * a)) ** 2),
        np.where(angle < 1e-2, 1 / 6 - a2 / 120 + a2 * a2 / 5040, (a - np.sin(a)) / a**3),
    )


def exp(phi: Array) -> Array:
    """Rotation matrix of a rotation vector (Rodrigues), shape (..., 3) [rad] -> (..., 3, 3)."""
    phi = np.asarray(phi, float)
    s, c, _ = _sinc_terms(np.linalg.norm(phi, axis=-1))
    K = hat(phi)
    return np.eye(3) + s[..., None, None] * K + c[..., None, None] * (K @ K)


def log(R: Array) -> Array:
    """Rotation vector of a rotation matrix, angle in [0, pi], shape (..., 3, 3) -> (..., 3) [rad]."""
    return quat_log(quat_from_matrix(R))


def quat_multiply(a: Array, b: Array) -> Array:
    """Hamilton product `a * b` of quaternions xyzw, shapes (..., 4)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., :3] = aw * bv + bw * av + cross(av, bv)
    out[..., 3] = aw[..., 0] * bw[..., 0] - np.sum(av * bv, axis=-1)
    return out


def quat_conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion xyzw, shape (..., 4)."""
    return np.array([-1.0, -1.0, -1.0, 1.0]) * q


def quat_rotate(q_AB: Array, v_B: Array) -> Array:
    """Rotate vectors from B to A, shapes (..., 4) and (..., 3) -> (..., 3)."""
    q_AB, v_B = np.asarray(q_AB, float), np.asarray(v_B, float)
    u, w = q_AB[..., :3], q_AB[..., 3:]
    t = 2.0 * cross(u, v_B)
    return v_B + w * t + cross(u, t)


def cross(a: Array, b: Array) -> Array:
    """`np.cross` of vectors, shapes (..., 3): the same bits in a third of its time, most of which (16 us) is the handling of axes."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    out[..., 0] = ay * bz - az * by
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def quat_to_matrix(q: Array) -> Array:
    """Rotation matrix of a unit quaternion xyzw, shape (..., 4) -> (..., 3, 3)."""
    q = np.asarray(q, float)
    # One quaternion in plain floats: 4 us, where arrays of single numbers take 40. The formula and its bits are the same.
    x, y, z, w = q.tolist() if q.ndim == 1 else np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows) if q.ndim == 1 else np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quat_from_matrix(R: Array) -> Array:
    """Unit quaternion xyzw with w >= 0 of a rotation matrix, shape (..., 3, 3) -> (..., 4).

    Takes the best conditioned of Shepperd's four forms, so that it is exact at 180 degrees too.
    """
    R = np.asarray(R, float)
    d = np.stack([R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]], axis=-1)
    trace = d.sum(axis=-1)
    # Row k of this symmetric matrix is 4 q_k q: pick the row with the largest diagonal.
    K = np.empty(R.shape[:-2] + (4, 4))
    for i in range(3):
        K[..., i, i] = 1 + 2 * d[..., i] - trace
        j, k = (i + 1) % 3, (i + 2) % 3
        K[..., i, j] = K[..., j, i] = R[..., i, j] + R[..., j, i]
        K[..., i, 3] = K[..., 3, i] = R[..., k, j] - R[..., j, k]
    K[..., 3, 3] = 1 + trace
    best = np.argmax(np.diagonal(K, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(K, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    upper: Array = np.where(q[..., 3:] < 0, -q, q)
    return upper


def quat_exp(phi: Array) -> Array:
    """Unit quaternion xyzw of a rotation vector, shape (..., 3) [rad] -> (..., 4)."""
    phi = np.asarray(phi, float)
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    safe = np.where(angle < _SMALL, 1.0, angle)
    factor = np.where(angle < _SMALL, 0.5 - angle**2 / 48, np.sin(0.5 * safe) / safe)
    return np.concatenate([factor * phi, np.cos(0.5 * angle)], axis=-1)


def quat_log(q: Array) -> Array:
    """Rotation vector of a unit quaternion xyzw, angle in [0, pi], shape (..., 4) -> (..., 3) [rad]."""
    q = np.asarray(q, float)
    q = np.where(q[..., 3:] < 0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    safe = np.where(sine < _SMALL, 1.0, sine)
    factor = np.where(sine < _SMALL, 2.0 / q[..., 3:].clip(0.5), 2.0 * np.arctan2(safe, q[..., 3:]) / safe)
    return factor * q[..., :3]


def quat_slerp(q0: Array, q1: Array, s: float | Array) -> Array:
    """Shortest-path interpolation between unit quaternions xyzw, s in [0, 1]."""
    step = quat_log(quat_multiply(quat_conjugate(q0), q1))
    return quat_multiply(q0, quat_exp(np.asarray(s, float)[..., None] * step))


def yaw_of(R_WB: Array) -> Array:
    """Yaw with b2 parallel to (-sin yaw, cos yaw, 0) in the horizontal plane [rad]. [M:eq12]

    Computed from b2, not b1: at a pitch of 90 degrees b2 is unchanged, while b1 is vertical.
    """
    R_WB = np.asarray(R_WB, float)
    return np.arctan2(-R_WB[..., 0, 1], R_WB[..., 1, 1])


def nearest(A: Array) -> Array:
    """Return the rotation nearest to a matrix (3, 3) in the Frobenius norm: for a mean of rotations, their chordal mean; for
    sum(a b^T), the R that best rotates each b to its a (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd(A)
    R: Array = U * (1.0, 1.0, np.sign(np.linalg.det(U @ Vt))) @ Vt
    return R


def angle_between(a: Array, b: Array) -> Array:
    """Angle between vectors, accurate near 0 and pi, shapes (..., 3) -> (...) [rad]."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    angle: Array = np.arctan2(np.linalg.norm(cross(a, b), axis=-1), np.sum(a * b, axis=-1))
    return angle
