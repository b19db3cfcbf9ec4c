"""From state and reference to rotor commands in one compiled call: prediction, control law, allocation, rotor lead."""

from __future__ import annotations

from perch_core.jit import compiled
from perch_core.vector3 import axes_of, axpy, cross, dot, scale, times, turned
from perch_core.vehicle import GRAVITY
from perch_control.allocation import allocate
from perch_control.geometric.law import geometric_step
from perch_control.rotor_lag import followed, lag_share, leading_command, reachable, thrusts


@compiled
def wrench_of(f, forward):
    """Collective thrust and moments of rotor thrusts. [P:eq2]

    Args:
        f: rotor thrusts [N], 4 floats.
        forward: rows x, y, yaw of the allocation matrix: moments per thrust [m], 3 x 4 floats.
    """
    x, y, z = forward
    return (
        f[0] + f[1] + f[2] + f[3],
        x[0] * f[0] + x[1] * f[1] + x[2] * f[2] + x[3] * f[3],
        y[0] * f[0] + y[1] * f[1] + y[2] * f[2] + y[3] * f[3],
        z[0] * f[0] + z[1] * f[1] + z[2] * f[2] + z[3] * f[3],
    )


@compiled
def predicted(state, f, extra, duration, mass, J, forward):
    """State after a short time under constant rotor thrusts. [M:eq1]

    Args:
        state: p_WB, v_WB, q_WB (xyzw), w_WB_B, 13 floats.
        f: rotor thrusts [N], 4 floats.
        extra: compensation of the known disturbance (see `geometric_step`); the disturbance itself is its negative.
        duration: [s].
        mass, J, forward: constants of the vehicle.

    Returns:
        State, 13 floats.
    """
    p, v = (state[0], state[1], state[2]), (state[3], state[4], state[5])
    q, w = (state[6], state[7], state[8], state[9]), (state[10], state[11], state[12])
    T, Mx, My, Mz = wrench_of(f, forward)
    gyro = cross(w, times(J, w))
    dw = ((Mx - gyro[0]) / J[0] - extra[3], (My - gyro[1]) / J[1] - extra[4], (Mz - gyro[2]) / J[2] - extra[5])
    # Constant thrust along the mean b3 of the interval: exact to second order in the duration.
    _, _, b3 = axes_of(turned(q, scale(0.5 * duration, axpy(0.25 * duration, dw, w))))
    a = axpy(T / mass, b3, (-extra[0], -extra[1], -extra[2] - GRAVITY))
    p1 = axpy(duration, axpy(0.5 * duration, a, v), p)
    v1 = axpy(duration, a, v)
    q1 = turned(q, scale(duration, axpy(0.5 * duration, dw, w)))
    w1 = axpy(duration, dw, w)
    return (p1[0], p1[1], p1[2], v1[0], v1[1], v1[2], q1[0], q1[1], q1[2], q1[3], w1[0], w1[1], w1[2])


@compiled
def drag_compensation(q, v, drag, extra):
    """Return `extra` plus the compensation of the rotor drag `drag` (per mass, axes of B) [1/s] at a velocity in W."""
    b1, b2, b3 = axes_of(q)
    d = axpy(drag[0] * dot(b1, v), b1, axpy(drag[1] * dot(b2, v), b2, scale(drag[2] * dot(b3, v), b3)))
    return (extra[0] + d[0], extra[1] + d[1], extra[2] + d[2], extra[3], extra[4], extra[5])


@compiled
def predicted_with_lag(state, speed, command, extra, duration, vehicle):
    """As `predicted`, under rotor drag and the thrusts that the rotors have in the middle of the time; arguments as in `control_step`."""
    coefficient, _, _, tau = vehicle[1]
    f = thrusts(followed(speed, command, 0.5 * duration, tau), coefficient)
    with_drag = drag_compensation(state[6:10], state[3:6], vehicle[4], extra)
    return predicted(state, f, with_drag, duration, vehicle[0][0], vehicle[0][1:4], vehicle[2])


@compiled
def rotors_for(wrench, speed, vehicle, lead):
    """Rotor commands that reach a wrench after the lead time, with priority of tilt over thrust over yaw.

    Args:
        wrench: thrust [N] and moments [N m], 4 floats.
        speed: present rotor speeds [rad/s], 4 floats.
        vehicle: constants (see `packed_vehicle`).
        lead: lead time [s].

    Returns:
        Commanded speeds [rad/s] and the thrusts that they reach [N], 4 floats each.
    """
    coefficient, speed_min, speed_max, tau = vehicle[1]
    share = lag_share(lead, tau)
    low, high = reachable(speed, share, speed_min, speed_max)
    lo, hi = thrusts(low, coefficient), thrusts(high, coefficient)
    floor, ceiling = coefficient * speed_min * speed_min, coefficient * speed_max * speed_max
    f = allocate(wrench, lo, hi, floor, ceiling, vehicle[2], vehicle[3])
    return leading_command(speed, f, coefficient, share, speed_min, speed_max), f


@compiled
def control_step(state, reference, speed, command, extra, gains, limits, lead, lag, vehicle):
    """One control period. [M:eq2]

    The state is predicted to the time at which the rotors reach the present demand, and the law is evaluated there.

    Args:
        state: p_WB, v_WB, q_WB (xyzw), w_WB_B now, 13 floats.
        reference: setpoint `lag` seconds from now, 33 floats; see `geometric_step`.
        speed, command: present rotor speeds and their commands [rad/s], 4 floats each.
        extra, gains, limits: see `geometric_step`.
        lead: time in which the rotors would reach the wanted thrust if the command stayed [s].
        lag: delay with which they follow it, with a new command in every period [s] (`rotor_lag.lag_behind`).
        vehicle: (mass, Jx, Jy, Jz), (thrust coefficient, lowest and highest speed, time constant), moment rows (3 x 4),
            mixing columns (4 x 4), rotor drag / mass (3).

    Returns:
        Commanded rotor speeds (4) [rad/s], wanted wrench (4) [N, N m], rotor thrusts that will be reached (4) [N],
        q_C (4), w_C and dw_C in B (3, 3).
    """
    mass, J = vehicle[0][0], vehicle[0][1:4]
    ahead = predicted_with_lag(state, speed, command, extra, lag, vehicle)
    # The wanted velocity, not the measured one: its noise would come back as thrust.
    extra = drag_compensation(ahead[6:10], reference[3:6], vehicle[4], extra)
    thrust, M, q_C, w_C, dw_C = geometric_step(ahead, reference, extra, gains, limits, J)
    wrench = (mass * thrust, M[0], M[1], M[2])
    out, f = rotors_for(wrench, speed, vehicle, lead)
    return out, wrench, f, q_C, w_C, dw_C
