"""Vectors and quaternions as tuples of floats, for code that is compiled (see `jit`).

At 500 Hz, numpy's overhead per call on three numbers would dominate the controller's computing time.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

from perch_core.arrays import Numbers, Quaternion, Vector3
from perch_core.jit import compiled


@compiled
def dot(a: Numbers, b: Numbers) -> float:
    """Scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Numbers, b: Numbers) -> Vector3:
    """Vector product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def axpy(s: float, a: Numbers, b: Numbers) -> Vector3:
    """`s a + b`."""
    return (s * a[0] + b[0], s * a[1] + b[1], s * a[2] + b[2])


@compiled
def scale(s: float, a: Numbers) -> Vector3:
    """`s a`."""
    return (s * a[0], s * a[1], s * a[2])


@compiled
def times(a: Numbers, b: Numbers) -> Vector3:
    """Product by component, a diagonal matrix times a vector."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@compiled
def norm(a: Numbers) -> float:
    """Euclidean length."""
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@compiled
def limited(a: Numbers, bound: float) -> Vector3:
    """Return the vector, shortened to a length of at most `bound`."""
    n = norm(a)
    if n > bound:
        return scale(bound / n, a)
    return (a[0], a[1], a[2])


@compiled
def axes_of(q: Numbers) -> tuple[Vector3, Vector3, Vector3]:
    """Columns b1, b2, b3 of the rotation matrix of a unit quaternion xyzw."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w)),
        (2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w)),
        (2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)),
    )


@compiled
def quaternion_product(a: Numbers, b: Numbers) -> Quaternion:
    """Hamilton product of quaternions xyzw."""
    return (
        a[3] * b[0] + b[3] * a[0] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] + b[3] * a[1] + a[2] * b[0] - a[0] * b[2],
        a[3] * b[2] + b[3] * a[2] + a[0] * b[1] - a[1] * b[0],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@compiled
def turned(q: Numbers, phi: Numbers) -> Quaternion:
    """Unit quaternion of `q` followed by the rotation vector `phi` in the body's axes [rad]."""
    angle = norm(phi)
    k = 0.5 if angle < 1e-6 else sin(0.5 * angle) / angle
    out = quaternion_product(q, (k * phi[0], k * phi[1], k * phi[2], cos(0.5 * angle)))
    n = 1.0 / sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    return (n * out[0], n * out[1], n * out[2], n * out[3])


@compiled
def rotation_vector(a: Numbers, b: Numbers) -> Vector3:
    """The shortest rotation from one unit quaternion to another, in the first one's axes [rad]: `turned(a, phi)` is b or -b."""
    x, y, z, w = quaternion_product((-a[0], -a[1], -a[2], a[3]), b)
    sine = sqrt(x * x + y * y + z * z)
    k = 2.0 if sine < 1e-9 else 2.0 * atan2(sine, abs(w)) / sine
    return scale(k if w >= 0.0 else -k, (x, y, z))


@compiled
def quaternion_of(b1: Numbers, b2: Numbers, b3: Numbers) -> Quaternion:
    """Unit quaternion xyzw, w >= 0, of the rotation with columns b1, b2, b3: the best conditioned of Shepperd's forms."""
    trace = b1[0] + b2[1] + b3[2]
    if trace > 0.0:
        x, y, z, w = b2[2] - b3[1], b3[0] - b1[2], b1[1] - b2[0], 1.0 + trace
    elif b1[0] >= b2[1] and b1[0] >= b3[2]:
        x, y, z, w = 1.0 + b1[0] - b2[1] - b3[2], b1[1] + b2[0], b3[0] + b1[2], b2[2] - b3[1]
    elif b2[1] >= b3[2]:
        x, y, z, w = b1[1] + b2[0], 1.0 - b1[0] + b2[1] - b3[2], b2[2] + b3[1], b3[0] - b1[2]
    else:
        x, y, z, w = b3[0] + b1[2], b2[2] + b3[1], 1.0 - b1[0] - b2[1] + b3[2], b1[1] - b2[0]
    n = 1.0 / sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        n = -n
    return (n * x, n * y, n * z, n * w)
