"""One step of geometric tracking control on SE(3), scalar by scalar. [M:eq2, M:eq12, M:eq13]

The commanded attitude follows from the force f that position feedback and feed-forward demand; the commanded body rates
and angular accelerations are those of the reference's force direction.

All arguments and results are tuples of floats (see `vector3`); accelerations and forces are per unit of mass.
"""

from __future__ import annotations

from math import sqrt

from perch_core.flatness import commanded_frame
from perch_core.jit import compiled
from perch_core.vector3 import axes_of, axpy, cross, dot, limited, norm, quaternion_of, quaternion_product, scale, times
from perch_core.vehicle import GRAVITY

CONE_CLOSING = 0.3  # time over which the cone closes before a contact: the thrust is low by then [s]


@compiled
def cone_before_contact(time_to_contact, widest, settling):
    """Tangent of the cone's half angle: `widest`, closed linearly, and zero from `settling` before the contact on.

    Feedback that turned the thrust in the last moments would tilt the vehicle at the contact, and hardly move it until then.

    Args:
        time_to_contact: [s].
        widest: tangent far from a contact.
        settling: time in which an error of the tilt settles [s].
    """
    return widest * min(max((time_to_contact - settling) / CONE_CLOSING, 0.0), 1.0)


@compiled
def position_feedback(e_p, e_v, k_p, k_v, bound):
    """Acceleration demanded by the errors, bounded. [M:eq2]"""
    return limited(axpy(-1.0, times(k_p, e_p), scale(-1.0, times(k_v, e_v))), bound)


@compiled
def force_about(a_ref, feedback, axis, tilt_tangent, floor):
    """Specific force f within a cone about the reference's thrust direction. [M:eq10]

    The feedback may turn the thrust away from the reference's direction only within the cone; so it can neither turn the vehicle
    over nor follow noise where the thrust is low. A small thrust has little lateral effect at any angle: below the weight, the
    cone narrows in proportion to it, so that near free fall only the planned attitude is flown.

    Args:
        a_ref: acceleration of the reference in W [m/s^2].
        feedback: acceleration that is added to it [m/s^2].
        axis: direction of the reference's thrust; in free fall the vehicle's own b3, which demands no rotation.
        tilt_tangent: tangent of the cone's half angle.
        floor: least part of f along the axis [m/s^2].

    Returns:
        f (3), its part along the axis [m/s^2].
    """
    total = (a_ref[0] + feedback[0], a_ref[1] + feedback[1], a_ref[2] + feedback[2] + GRAVITY)
    along = dot(total, axis)
    across = axpy(-along, axis, total)
    along = max(along, floor)
    limit = tilt_tangent * min(along / GRAVITY, 1.0)
    width, limit = norm(across), limit * along
    if width > limit:
        across = scale(limit / width, across)
    return axpy(along, axis, across), along


@compiled
def attitude_error(q, q_C):
    """Attitude error e_R in B [rad]. [M:eq2]

    `2 sin(angle / 2) axis` of the two rotations that compose q_C^-1 q: the shortest one between both b3, and the remaining one
    about b3. To first order that is the paper's `vee(R_C^T R - R^T R_C) / 2`, but it grows up to 180 degrees, so that an inverted
    vehicle is turned back. A large heading error does not deflect the tilt error: with one common axis, a spinning vehicle would
    be tilted in a spiral.
    """
    e = quaternion_product((-q_C[0], -q_C[1], -q_C[2], q_C[3]), q)
    upright = sqrt(e[2] * e[2] + e[3] * e[3])
    if upright < 1e-6:  # b3 opposite to the commanded one: any axis across it is a shortest one
        return (2.0 * e[0], 2.0 * e[1], 0.0)
    k = 2.0 / upright
    turn = k * e[2] if e[3] >= 0.0 else -k * e[2]
    return (k * (e[3] * e[0] + e[1] * e[2]), k * (e[3] * e[1] - e[0] * e[2]), turn)


@compiled
def moment(w, e_R, w_C_B, dw_C_B, J, k_R, k_w, dw_extra):
    """Moment in B. [M:eq2]

    Args:
        w: body rates [rad/s].
        e_R: attitude error [rad].
        w_C_B, dw_C_B: commanded body rates and accelerations turned into B, R^T R_C w_C and R^T R_C dw_C.
        J: principal moments of inertia [kg m^2].
        k_R, k_w: gains [1/s^2, 1/s]; k_R and k_Omega of the paper are J k_R and J k_w.
        dw_extra: angular acceleration that compensates for a known disturbance [rad/s^2].
    """
    e_w = axpy(-1.0, w_C_B, w)
    Jw = times(J, w)
    turn = cross(w, w_C_B)
    demand = (
        -k_R[0] * e_R[0] - k_w[0] * e_w[0] - turn[0] + dw_C_B[0] + dw_extra[0],
        -k_R[1] * e_R[1] - k_w[1] * e_w[1] - turn[1] + dw_C_B[1] + dw_extra[1],
        -k_R[2] * e_R[2] - k_w[2] * e_w[2] - turn[2] + dw_C_B[2] + dw_extra[2],
    )
    return axpy(1.0, times(J, demand), cross(w, Jw))


@compiled
def geometric_step(state, reference, extra, gains, limits, J):
    """Wanted specific thrust and moment. [defines M:eq2] [M:eq12, M:eq13]

    Args:
        state: p_WB, v_WB, q_WB (xyzw), w_WB_B, 13 floats.
        reference: p, v, a, j, s in W, then b2_des and b3 (zero: follows from the force) with their first two derivatives,
            33 floats.
        extra: acceleration in W and angular acceleration in B that compensate for known disturbances, 6 floats.
        gains: k_p, k_v, k_R, k_w, 12 floats.
        limits: bound of the position feedback [m/s^2], tangent of its cone, floor of the specific force [m/s^2],
            bounds of commanded rates [rad/s] and accelerations [rad/s^2], 5 floats.
        J: principal moments of inertia [kg m^2], 3 floats.

    Returns:
        Specific thrust along b3 [m/s^2], moment (3) [N m], q_C (4), w_C and dw_C turned into B (3, 3).
    """
    p, v = (state[0], state[1], state[2]), (state[3], state[4], state[5])
    q, w = (state[6], state[7], state[8], state[9]), (state[10], state[11], state[12])
    p_r, v_r, a_r = reference[0:3], reference[3:6], reference[6:9]
    jerk, snap = reference[9:12], reference[12:15]
    h, dh, ddh = reference[15:18], reference[18:21], reference[21:24]
    k_p, k_v, k_R, k_w = gains[0:3], gains[3:6], gains[6:9], gains[9:12]
    B1, B2, B3 = axes_of(q)

    axis, daxis, ddaxis, f_r = reference[24:27], reference[27:30], reference[30:33], (a_r[0], a_r[1], a_r[2] + GRAVITY)
    specific, carried = norm(f_r), dot(axis, axis) > 0.5
    if not carried and specific > limits[2]:
        axis, daxis, ddaxis = scale(1.0 / specific, f_r), scale(1.0 / specific, jerk), scale(1.0 / specific, snap)
    elif not carried:  # in free fall: no direction, and no rotation
        axis = B3
    e_p, e_v = axpy(-1.0, p_r, p), axpy(-1.0, v_r, v)
    feedback = position_feedback(e_p, e_v, k_p, k_v, limits[0])
    f, along = force_about(a_r, axpy(1.0, feedback, extra[0:3]), axis, limits[1], limits[2])

    # f turns as the reference's does, however much thrust the feedback adds or takes away.
    df, ddf = scale(along, daxis), scale(along, ddaxis)

    n = cross(h, f)
    if dot(n, n) < 1e-4 * dot(f, f):  # b2_des within 0.6 degrees of the thrust: keep the present heading instead
        h, dh, ddh = B2, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        n = cross(h, f)
        if dot(n, n) < 1e-4 * dot(f, f):
            h = cross(f, B1)
    b1, b2, b3, w_C, dw_C = commanded_frame(f, df, ddf, h, dh, ddh)
    w_C, dw_C = limited(w_C, limits[3]), limited(dw_C, limits[4])

    q_C = quaternion_of(b1, b2, b3)
    e_R = attitude_error(q, q_C)
    w_C_W = axpy(w_C[0], b1, axpy(w_C[1], b2, scale(w_C[2], b3)))
    dw_C_W = axpy(dw_C[0], b1, axpy(dw_C[1], b2, scale(dw_C[2], b3)))
    w_C_B = (dot(B1, w_C_W), dot(B2, w_C_W), dot(B3, w_C_W))
    dw_C_B = (dot(B1, dw_C_W), dot(B2, dw_C_W), dot(B3, dw_C_W))
    M = moment(w, e_R, w_C_B, dw_C_B, J, k_R, k_w, extra[3:6])
    return dot(f, B3), M, q_C, w_C_B, dw_C_B
