"""The UKF's update with a VIO pose and the covariances around it, compiled: in numpy the calls cost a control period.

`kernels.py` holds the prediction, `unscented.py` and `drift.py` the equations. Indices follow `layout.py`.
"""

from __future__ import annotations

import math

import numpy as np

from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, quaternion_product, turned
from perch_perception.ukf.kernels import cholesky

_UNIT = (0.0, 0.0, 0.0, 1.0)


@compiled
def _rotation_vector(q):
    """Logarithm of a unit quaternion xyzw, of the shorter rotation."""
    sign = -1.0 if q[3] < 0.0 else 1.0
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    f = sign * (2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, sign * q[3]) / sine)
    return (f * q[0], f * q[1], f * q[2])


@compiled
def vios_attitude(x):
    """Attitude that VIO would report at the nominal state x (22,): exp(drift) R_WB, xyzw."""
    return quaternion_product(turned(_UNIT, (x[19], x[20], x[21])), (x[6], x[7], x[8], x[9]))


@compiled
def take_over_pose(x):
    """Give the nominal state x (22,) the pose that VIO would report there and no drift; the turn in B, a rotation vector."""
    q = vios_attitude(x)
    turn = _rotation_vector(quaternion_product((-x[6], -x[7], -x[8], x[9]), q))
    for i in range(3):
        x[i] += x[16 + i]
    for i in range(4):
        x[6 + i] = q[i]
    for i in range(16, 22):
        x[i] = 0.0
    return turn


@compiled
def _vios_attitude_near(x, sign, e):
    """As `vios_attitude`, of the nominal state moved by the error sign * e (21,)."""
    q = turned((x[6], x[7], x[8], x[9]), (sign * e[6], sign * e[7], sign * e[8]))
    return quaternion_product(turned(_UNIT, (x[19] + sign * e[18], x[20] + sign * e[19], x[21] + sign * e[20])), q)


@compiled
def innovate(x, P, p, q, R, scale, wm0, wc0, wi, residual, S, gain):
    """`UnscentedTransform.innovate`.

    Args:
        x, P: nominal state (22,) and covariance (21, 21).
        p, q: VIO's pose, (3,), (4,).
        R: white measurement noise, (6, 6).
        scale: n + lambda; wm0, wc0: centre weights for mean and covariance; wi: weight of every other point.
        residual, S, gain: results (6,), (6, 6), (21, 6), overwritten.

    Returns:
        Normalised innovation squared; -1 where P is not positive definite (the results are then undefined).
    """
    n = 21
    L = np.zeros((n, n))
    if not cholesky(P, scale, L):
        return -1.0
    columns = L.T.copy()
    Z = np.zeros((2 * n + 1, 6))
    centre = vios_attitude(x)
    back = (-centre[0], -centre[1], -centre[2], centre[3])
    for s in range(2 * n + 1):
        e = columns[(s - 1) % n]
        sign = 0.0 if s == 0 else (1.0 if s <= n else -1.0)
        turn = _rotation_vector(quaternion_product(_vios_attitude_near(x, sign, e), back))
        for i in range(3):
            Z[s, i] = x[i] + x[16 + i] + sign * (e[i] + e[15 + i])
            Z[s, 3 + i] = turn[i]
    measured = _rotation_vector(quaternion_product((q[0], q[1], q[2], q[3]), back))
    for i in range(6):
        mean = wm0 * Z[0, i]
        for s in range(1, 2 * n + 1):
            mean += wi * Z[s, i]
        residual[i] = (p[i] if i < 3 else measured[i - 3]) - mean
        for s in range(2 * n + 1):
            Z[s, i] -= mean
    for i in range(6):
        for j in range(i + 1):
            total = wc0 * Z[0, i] * Z[0, j]
            for s in range(1, 2 * n + 1):
                total += wi * Z[s, i] * Z[s, j]
            S[i, j] = total + R[i, j]
            S[j, i] = total + R[j, i]
    for i in range(6):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += (Z[1 + k, i] - Z[1 + n + k, i]) * columns[k, j]
            gain[j, i] = wi * total  # the cross covariance, for now
    factor = np.zeros((6, 6))
    if not cholesky(S, 1.0, factor):
        return -1.0
    for j in range(n):
        _solve(factor, gain[j])
    weighed = residual.copy()
    _solve(factor, weighed)
    return (residual * weighed).sum()


@compiled
def correct(x, P, gain, S, residual, x_out, P_out):
    """`UnscentedTransform.correct`: the state (22,) and covariance (21, 21) after a measurement, into x_out and P_out."""
    n = 21
    step, spread = np.zeros(n), np.zeros((n, 6))
    for i in range(n):
        for k in range(6):
            step[i] += gain[i, k] * residual[k]
            for m in range(6):
                spread[i, k] += gain[i, m] * S[m, k]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += spread[i, k] * gain[j, k]
            P_out[i, j] = P_out[j, i] = 0.5 * (P[i, j] + P[j, i]) - total
    phi = (step[6], step[7], step[8])
    for j in range(n):
        column = _right_jacobian(phi, (P_out[6, j], P_out[7, j], P_out[8, j]))
        for i in range(3):
            P_out[6 + i, j] = column[i]
    for i in range(n):
        row = _right_jacobian(phi, (P_out[i, 6], P_out[i, 7], P_out[i, 8]))
        for j in range(3):
            P_out[i, 6 + j] = row[j]
    for i in range(6):
        x_out[i] = x[i] + step[i]
        x_out[10 + i] = x[10 + i] + step[9 + i]
        x_out[16 + i] = x[16 + i] + step[15 + i]
    q = turned((x[6], x[7], x[8], x[9]), phi)
    for i in range(4):
        x_out[6 + i] = q[i]


@compiled
def _right_jacobian(phi, v):
    """J v with J = I - (1 - cos a) / a^2 [phi]x + (a - sin a) / a^3 [phi]x^2, a = |phi|."""
    a = norm(phi)
    f = 0.5 - a * a / 24.0 if a < 1e-4 else (1.0 - math.cos(a)) / (a * a)
    g = 1.0 / 6.0 - a * a / 120.0 if a < 1e-4 else (a - math.sin(a)) / (a * a * a)
    once = cross(phi, v)
    return axpy(g, cross(phi, once), axpy(-f, once, v))


@compiled
def _solve(L, y):
    """y := (L L^T)^-1 y for a lower factor L."""
    n = len(y)
    for i in range(n):
        for k in range(i):
            y[i] -= L[i, k] * y[k]
        y[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            y[i] -= L[k, i] * y[k]
        y[i] /= L[i, i]


@compiled
def clipped(A, scale, low):
    """s_i s_j B_ij, with B = A_ij / (s_i s_j) whose eigenvalues are raised to `low` where they are smaller; (n, n)."""
    n = len(scale)
    B = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            B[i, j] = A[i, j] / (scale[i] * scale[j])
    values, vectors = np.linalg.eigh(B)
    out = np.zeros((n, n))
    for k in range(n):
        value = max(values[k], low)
        for i in range(n):
            for j in range(n):
                out[i, j] += value * vectors[i, k] * vectors[j, k]
    for i in range(n):
        for j in range(n):
            out[i, j] *= scale[i] * scale[j]
    return out


@compiled
def missing(C, P):
    """Positive part of C - P, (n, n), in units of C's own sigmas."""
    n = len(C)
    scale = np.empty(n)
    for i in range(n):
        scale[i] = math.sqrt(max(C[i, i], 1e-12))
    return clipped(C - P, scale, 0.0)


@compiled
def add_process_noise(run, gyro_walk2, accel_walk2, P):
    """Add to P (21, 21) what a run's IMU noise and bias walks do, see `UnscentedTransform.process_noise`."""
    T, q, turn = 0.0, 0.0, 0.0
    for k in range(run.shape[0]):
        dt = run[k, 0]
        T += dt
        turn += run[k, 7] * dt * dt
        q += run[k, 8] * dt * dt
    for d in range(3):
        P[d, d] += q * T * T / 3.0
        P[d, 3 + d] += q * T / 2.0
        P[3 + d, d] += q * T / 2.0
        P[3 + d, 3 + d] += q
        P[6 + d, 6 + d] += turn
        P[9 + d, 9 + d] += gyro_walk2 * T
        P[12 + d, 12 + d] += accel_walk2 * T
