"""Compiled update of the UKF with a measurement: in numpy, its calls would take a whole control period.

`kernels.py` holds the prediction, `unscented.py` the equations. Indices follow `layout.py`.
"""

from __future__ import annotations

import math

import numpy as np

from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, quaternion_product
from perch_perception.ukf.kernels import cholesky, moved, rotation_vector


@compiled
def _predict_measurement(x, back, z):
    """Write the predicted measurement of state x (16,) to z, (6,) or (9,), its attitude relative to the inverse of `back`."""
    q = (x[6], x[7], x[8], x[9])
    turn = rotation_vector(quaternion_product(q, back))
    for i in range(3):
        z[i] = x[i]
        z[3 + i] = turn[i]
    if len(z) == 9:
        v = _rotated_back(q, (x[3], x[4], x[5]))
        for i in range(3):
            z[6 + i] = v[i]


@compiled
def _rotated_back(q, v):
    """Return R^T v for a unit quaternion xyzw."""
    u = (-q[0], -q[1], -q[2])
    t = cross(u, v)
    t = (2.0 * t[0], 2.0 * t[1], 2.0 * t[2])
    return axpy(1.0, cross(u, t), axpy(q[3], t, v))


@compiled
def innovate(x, P, measured, R, scale, wm0, wc0, wi, residual, S, gain):
    """Compute `UnscentedTransform.innovate`.

    Args:
        x, P: nominal state (16,) and covariance (15, 15).
        measured: position and attitude xyzw, (7,); where R has nine rows, also the velocity in B, (10,).
        R: measurement noise, (m, m).
        scale: n + lambda; wm0, wc0: centre weights for mean and covariance; wi: weight of every other point.
        residual, S, gain: results (m,), (m, m), (15, m), overwritten.

    Returns:
        Normalised innovation squared; -1 where P or S is not positive definite (the results are then undefined).
    """
    n, m = 15, len(R)
    L = np.zeros((n, n))
    if not cholesky(P, scale, L):
        return -1.0
    columns = L.T.copy()
    Z, y = np.zeros((2 * n + 1, m)), np.empty(16)
    back = (-x[6], -x[7], -x[8], x[9])
    for s in range(2 * n + 1):
        moved(x, 0.0 if s == 0 else (1.0 if s <= n else -1.0), columns[(s - 1) % n], y)
        _predict_measurement(y, back, Z[s])
    turn = rotation_vector(quaternion_product((measured[3], measured[4], measured[5], measured[6]), back))
    for i in range(m):
        mean = wm0 * Z[0, i]
        for s in range(1, 2 * n + 1):
            mean += wi * Z[s, i]
        residual[i] = (turn[i - 3] if 3 <= i < 6 else measured[i] if i < 3 else measured[i + 1]) - mean
        for s in range(2 * n + 1):
            Z[s, i] -= mean
    for i in range(m):
        for j in range(i + 1):
            total = wc0 * Z[0, i] * Z[0, j]
            for s in range(1, 2 * n + 1):
                total += wi * Z[s, i] * Z[s, j]
            S[i, j] = total + R[i, j]
            S[j, i] = total + R[j, i]
    for i in range(m):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += (Z[1 + k, i] - Z[1 + n + k, i]) * columns[k, j]
            gain[j, i] = wi * total  # the cross covariance, for now
    factor = np.zeros((m, m))
    if not cholesky(S, 1.0, factor):
        return -1.0
    for j in range(n):
        _solve(factor, gain[j])
    weighed = residual.copy()
    _solve(factor, weighed)
    return (residual * weighed).sum()


@compiled
def correct(x, P, gain, S, residual, x_out, P_out):
    """Compute `UnscentedTransform.correct`: state (16,) and covariance (15, 15) after a measurement, into x_out and P_out."""
    n, m = 15, len(residual)
    step, spread = np.zeros(n), np.zeros((n, m))
    for i in range(n):
        for k in range(m):
            step[i] += gain[i, k] * residual[k]
            for c in range(m):
                spread[i, k] += gain[i, c] * S[c, k]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(m):
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
    moved(x, 1.0, step, x_out)


@compiled
def _right_jacobian(phi, v):
    """Return J v with J = I - (1 - cos a) / a^2 [phi]x + (a - sin a) / a^3 [phi]x^2, a = |phi|."""
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
def add_process_noise(run, gyro_walk2, accel_walk2, P):
    """Add the noise and the bias walks of a run of IMU steps (m, 9) to P (15, 15).

    The white noise adds sum(s_g^2 dt^2) to the attitude, q = sum(s_a^2 dt^2) to the velocity and, by integration, q T^2/3 to the
    position and q T/2 to its covariance with the velocity. Couplings of higher order in T (40 ms) are neglected.
    """
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
