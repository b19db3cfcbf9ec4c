"""The UKF's inner loops in scalar form: one IMU step of the mean, and sigma points through a run of IMU steps.

The code is scalar because numba then needs about 0.1 us per IMU step and sigma point, whereas numpy needs 10 us per
operation on three numbers. Indices follow `layout.py`.
"""

from __future__ import annotations

import math

import numpy as np

from perch_core.jit import compiled
from perch_core.vector3 import quaternion_product
from perch_core.vehicle import GRAVITY


@compiled
def advance(x, w0, w1, w2, a0, a1, a2, dt):
    """Propagate a nominal state in place by one IMU step: constant rate and specific force over dt.

    p += v dt + (R a + g) dt^2 / 2,  v += (R a + g) dt,  q <- q exp(w dt), with R at the middle of the step
    (second order in the rotation: at 600 deg/s a first-order step would lose 6 mm/s in a 0.3 s flip).

    Args:
        x: nominal state, shape (>= 16,); changed.
        w0, w1, w2: measured angular velocity in B [rad/s].
        a0, a1, a2: measured specific force in B [m/s^2].
        dt: duration [s].
    """
    w0 -= x[10]
    w1 -= x[11]
    w2 -= x[12]
    a0 -= x[13]
    a1 -= x[14]
    a2 -= x[15]
    h = 0.5 * dt
    angle2 = (w0 * w0 + w1 * w1 + w2 * w2) * dt * dt
    angle = math.sqrt(angle2)
    # quaternion of half the rotation, applied twice: the first half gives R at the middle
    if angle < 1e-5:
        s = 0.5 * h * (1.0 - angle2 / 96.0)
    else:
        s = math.sin(0.25 * angle) / angle * dt
    c = math.cos(0.25 * angle)
    half = (s * w0, s * w1, s * w2, c)
    middle = quaternion_product((x[6], x[7], x[8], x[9]), half)
    m0, m1, m2, m3 = middle
    t0 = 2.0 * (m1 * a2 - m2 * a1)
    t1 = 2.0 * (m2 * a0 - m0 * a2)
    t2 = 2.0 * (m0 * a1 - m1 * a0)
    f0 = a0 + m3 * t0 + m1 * t2 - m2 * t1
    f1 = a1 + m3 * t1 + m2 * t0 - m0 * t2
    f2 = a2 + m3 * t2 + m0 * t1 - m1 * t0 - GRAVITY
    x[0] += (x[3] + h * f0) * dt
    x[1] += (x[4] + h * f1) * dt
    x[2] += (x[5] + h * f2) * dt
    x[3] += f0 * dt
    x[4] += f1 * dt
    x[5] += f2 * dt
    n0, n1, n2, n3 = quaternion_product(middle, half)
    norm = 1.0 / math.sqrt(n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3)
    x[6] = n0 * norm
    x[7] = n1 * norm
    x[8] = n2 * norm
    x[9] = n3 * norm


@compiled
def cholesky(P, scale, L):
    """Write the lower Cholesky factor of scale * P to L; return False where P is not positive definite."""
    n = P.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = scale * P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@compiled
def moved(x, sign, e, y):
    """Write the nominal state x (16,), moved by the error sign * e (15,), to y (16,)."""
    for i in range(6):
        y[i] = x[i] + sign * e[i]
        y[10 + i] = x[10 + i] + sign * e[9 + i]
    r0, r1, r2 = sign * e[6], sign * e[7], sign * e[8]
    angle = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
    f = 0.5 - angle * angle / 48.0 if angle < 1e-5 else math.sin(0.5 * angle) / angle
    y[6], y[7], y[8], y[9] = quaternion_product((x[6], x[7], x[8], x[9]), (f * r0, f * r1, f * r2, math.cos(0.5 * angle)))


@compiled
def rotation_vector(q):
    """Return the rotation vector of a unit quaternion xyzw, for the shorter rotation."""
    sign = -1.0 if q[3] < 0.0 else 1.0
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    f = sign * (2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, sign * q[3]) / sine)
    return (f * q[0], f * q[1], f * q[2])


@compiled
def unscented_run(x, P, imu, scale, wm0, wc0, wi, x_out, P_out):
    """Full unscented transform of (x, P) through a run of IMU steps, without process noise.

    Args:
        x, P: nominal state (16,) and covariance (15, 15).
        imu: rows (dt, wx, wy, wz, ax, ay, az), shape (m, >= 7).
        scale: n + lambda; wm0, wc0: centre weights for mean and covariance; wi: weight of every other point.
        x_out, P_out: results, overwritten.

    Returns:
        False where P is not positive definite (the results are then undefined).
    """
    n = 15
    L = np.zeros((n, n))
    if not cholesky(P, scale, L):
        return False
    columns = L.T.copy()
    points = 2 * n + 1
    Y = np.empty((points, 16))
    for s in range(points):
        sign = 0.0 if s == 0 else (1.0 if s <= n else -1.0)
        moved(x, sign, columns[(s - 1) % n], Y[s])
        for k in range(imu.shape[0]):
            advance(Y[s], imu[k, 1], imu[k, 2], imu[k, 3], imu[k, 4], imu[k, 5], imu[k, 6], imu[k, 0])
    # errors about the centre point's result; the centre's own error is zero
    D = np.zeros((points, n))
    mean = np.zeros(n)
    back = (-Y[0, 6], -Y[0, 7], -Y[0, 8], Y[0, 9])
    for s in range(1, points):
        for i in range(6):
            D[s, i] = Y[s, i] - Y[0, i]
            D[s, 9 + i] = Y[s, 10 + i] - Y[0, 10 + i]
        D[s, 6], D[s, 7], D[s, 8] = rotation_vector(quaternion_product(back, (Y[s, 6], Y[s, 7], Y[s, 8], Y[s, 9])))
        for i in range(n):
            mean[i] += wi * D[s, i]
    for i in range(n):
        for s in range(1, points):
            D[s, i] -= mean[i]
    for i in range(n):
        for j in range(i + 1):
            total = wc0 * mean[i] * mean[j]
            for s in range(1, points):
                total += wi * D[s, i] * D[s, j]
            P_out[i, j] = total
            P_out[j, i] = total
    moved(Y[0], 1.0, mean, x_out)
    return True
