"""Compiled parts of a real-time iteration besides the linearisation: at 500 Hz, numpy's calls would cost more than the QP.

`begin` is called before the linearisation, `finish` after it.
"""

from __future__ import annotations

from perch_control.geometric.step import predicted_with_lag, rotors_for, wrench_of
from perch_control.nmpc.model import DISTURBANCE, INPUTS, REFERENCE
from perch_control.nmpc.riccati import solve_stages
from perch_control.rotor_lag import lag_share, reachable, thrusts
from perch_core.jit import compiled


@compiled
def begin(state, speed, command, compensation, lead, vehicle, R, ramps, X, U, start, target, z):
    """Compute the initial state of the horizon, and the arguments of the linearisation.

    With 13 states, the initial state is predicted to the time at which the rotors have responded; with 17 states, it is the
    present state with the present thrusts.

    Args:
        state: p_WB, v_WB, q_WB (xyzw), w_WB_B now, 13 floats.
        speed, command: present rotor speeds and their commands [rad/s], 4 floats each.
        compensation: compensation of disturbances, 6 floats.
        lead: time of the prediction [s].
        vehicle: constants (see `packed_vehicle`).
        R: reference of the nodes, shape (N + 1, 17).
        ramps: whether the inputs change over their intervals as the reference's thrusts do; for 13 states only.
        X, U: iterate, shapes (N + 1, n), (N, 4); the sign of its quaternions is matched to the state's.
        start: result: the initial state, shape (n,).
        target: result: inputs from which the cost is measured, shape (N, 4); stays zero for 17 states.
        z: result: arguments, shape (N + 1, .).
    """
    nodes, n = X.shape
    coefficient, speed_min, speed_max, _ = vehicle[1]
    if n == 13:
        state = predicted_with_lag(state, speed, command, compensation, lead, vehicle)
    for i in range(3):
        start[i], start[7 + i], start[10 + i] = state[i], state[3 + i], state[10 + i]
    for i in range(4):
        start[3 + i] = state[6 + i]
    if n == 17:
        f = thrusts(speed, coefficient)
        for a in range(4):
            start[13 + a] = min(max(f[a], coefficient * speed_min * speed_min), coefficient * speed_max * speed_max)
    if X[0, 3] * start[3] + X[0, 4] * start[4] + X[0, 5] * start[5] + X[0, 6] * start[6] < 0.0:
        for k in range(nodes):
            for i in range(3, 7):
                X[k, i] = -X[k, i]
    for k in range(nodes):
        for i in range(n):
            z[k, i] = X[k, i]
        if k < nodes - 1:
            for a in range(4):
                z[k, n + a] = U[k, a]
                if n == 13:
                    target[k, a] = R[k, 13 + a]
        for i in range(REFERENCE):
            z[k, n + INPUTS + i] = R[k, i]
        if n == 13:
            for i in range(13, REFERENCE):
                z[k, n + INPUTS + i] = R[k + 1, i] - R[k, i] if ramps and k < nodes - 1 else 0.0
        for i in range(DISTURBANCE):
            z[k, n + INPUTS + REFERENCE + i] = -compensation[i]


@compiled
def input_bounds(speed, lead, vehicle, thrust_rate_max, n, low, high):
    """Write the bounds of the inputs, shapes (N, 4): thrusts, in the first interval reachable ones; thrust rates (17 states)."""
    coefficient, speed_min, speed_max, tau = vehicle[1]
    if n == 17:
        floor, ceiling = -thrust_rate_max, thrust_rate_max
    else:
        floor, ceiling = coefficient * speed_min * speed_min, coefficient * speed_max * speed_max
    for k in range(len(low)):
        for a in range(4):
            low[k, a], high[k, a] = floor, ceiling
    if n == 13:
        slow, fast = reachable(speed, lag_share(lead, tau), speed_min, speed_max)
        slow, fast = thrusts(slow, coefficient), thrusts(fast, coefficient)
        for a in range(4):
            low[0, a], high[0, a] = slow[a], fast[a]


@compiled
def apply(dx, du, X, U):
    """Add a solution to the iterate; quaternions are normalised."""
    nodes, n = X.shape
    for k in range(nodes):
        for i in range(n):
            X[k, i] += dx[k, i]
        s = 1.0 / (X[k, 3] ** 2 + X[k, 4] ** 2 + X[k, 5] ** 2 + X[k, 6] ** 2) ** 0.5
        for i in range(3, 7):
            X[k, i] *= s
        if k < nodes - 1:
            for a in range(4):
                U[k, a] += du[k, a]


@compiled
def first_command(U, n, speed, lead, vehicle):
    """Rotor commands [rad/s], wanted wrench [N, N m] and the thrusts that will be reached [N] for the first input, 4 floats each."""
    coefficient, speed_min, speed_max, _ = vehicle[1]
    f = (U[0, 0], U[0, 1], U[0, 2], U[0, 3])
    if n == 17:
        low, high, now = coefficient * speed_min * speed_min, coefficient * speed_max * speed_max, thrusts(speed, coefficient)
        f = (min(max(now[0] + lead * f[0], low), high), min(max(now[1] + lead * f[1], low), high),
             min(max(now[2] + lead * f[2], low), high), min(max(now[3] + lead * f[3], low), high))
    wrench = wrench_of(f, vehicle[2])
    out, reached = rotors_for(wrench, speed, vehicle, lead)
    return out, wrench, reached


@compiled
def finish(stages, X, U, start, weight, target, terminal, low, high, x_low, x_high, price, rounds, work, dx, du, speed, lead, vehicle):
    """Solve the QP, update the iterate, and return the first command; arguments as in `solve_stages` and `first_command`.

    Returns:
        Number of active sets tried (0: the correct one was not found, and the iterate is unchanged), and the result of
        `first_command`.
    """
    n = X.shape[1]
    for i in range(n):
        dx[0, i] = start[i] - X[0, i]
    tried = solve_stages(stages, X, U, dx[0], weight, target, terminal, low, high, x_low, x_high, price, rounds, work, dx, du)
    if tried > 0:
        apply(dx, du, X, U)
    return tried, first_command(U, n, speed, lead, vehicle)
