"""The geometric law against flatness, finite differences and its own singular cases."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles import rigid_body
from perch_control.admission import TrajectoryRefused
from perch_control.geometric import GeometricController, packed_vehicle
from perch_control.geometric.law import attitude_error, geometric_step
from perch_control.geometric.step import predicted
from perch_control.reference import FlatReference, SampledReference, Setpoint, packed_many
from perch_control.rotor_lag import RotorEstimate, leading_command, reachable, thrusts
from perch_core import so3
from perch_core.flatness import flat_to_state, heading_derivatives
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.vehicle import ControlGains, load_vehicle

VEHICLE = load_vehicle("snapdragon")
J = tuple(VEHICLE.inertia)
GAINS = (7.0, 7.0, 9.0, 4.5, 4.5, 5.5, 400.0, 400.0, 60.0, 30.0, 30.0, 10.0)
FREE = (1e9, 1e9, 0.1, 1e9, 1e9)  # limits that never act
NONE = (0.0,) * 6


def flat(rng, yaw_rate=True):
    p, v, a, j, s = (rng.normal(size=3) * k for k in (1, 1, 4, 10, 50))
    yaw = rng.normal(size=3) * (1, 1, 2) if yaw_rate else np.array([0.3, 0, 0])
    return p, v, a, j, s, *yaw


def setpoint(x):
    return Setpoint(*(tuple(map(float, v)) for v in x[:5]), *heading_derivatives(*map(float, x[5:])))


def body(R, w):
    return (*Rotation.from_matrix(R).as_quat(), *w)


@pytest.mark.parametrize("seed", range(20))
def test_on_the_reference_the_law_is_flatness(seed):
    """Without errors [M:eq2] is feed-forward: thrust, attitude, rates and moment of [M:eq9-13] and [M:eq1]."""
    x = flat(np.random.default_rng(seed))
    expected = flat_to_state(*x, mass=VEHICLE.mass)
    R, w, dw = expected.R_WB, expected.w_WB_B, expected.dw_WB_B
    state = tuple(float(v) for v in (*x[0], *x[1], *body(R, w)))
    thrust, M, q_C, w_C, dw_C = geometric_step(state, setpoint(x).packed, NONE, GAINS, FREE, J)
    assert thrust * VEHICLE.mass == pytest.approx(expected.thrust)
    np.testing.assert_allclose(Rotation.from_quat(q_C).as_matrix(), R, atol=1e-9)
    np.testing.assert_allclose(w_C, w, atol=1e-8 * (1 + np.abs(w).max()))
    np.testing.assert_allclose(dw_C[:2], dw[:2], rtol=1e-6, atol=1e-6 * (1 + np.abs(dw).max()))
    moment = np.array(J) * np.array(dw_C) + np.cross(w, np.array(J) * w)
    np.testing.assert_allclose(M, moment, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_off_the_reference_thrust_and_commanded_attitude_are_the_printed_ones(seed):
    """f = -k_x e_x - k_v e_v + g e3 + a and what compensates for a disturbance; the thrust is f . R e3, R_C = [b2 x b3, b2, b3]. [tests M:eq2,10,12]"""
    rng = np.random.default_rng(seed)
    x, e_x, e_v, d, R = flat(rng), rng.normal(size=3), rng.normal(size=3), rng.normal(size=3), Rotation.random(random_state=seed)
    state = tuple(float(v) for v in (*(x[0] + e_x), *(x[1] + e_v), *R.as_quat(), *rng.normal(size=3)))
    thrust, _, q_C, _, _ = geometric_step(state, setpoint(x).packed, (*d, 0.0, 0.0, 0.0), GAINS, FREE, J)
    f = -np.multiply(GAINS[0:3], e_x) - np.multiply(GAINS[3:6], e_v) + (0.0, 0.0, 9.81) + x[2] + d
    b3 = f / np.linalg.norm(f)
    b1 = np.cross((-np.sin(x[5]), np.cos(x[5]), 0.0), b3)
    b1 /= np.linalg.norm(b1)
    assert thrust == pytest.approx(f @ R.as_matrix()[:, 2])
    np.testing.assert_allclose(Rotation.from_quat(q_C).as_matrix(), np.column_stack([b1, np.cross(b3, b1), b3]), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_off_the_reference_the_moment_is_the_printed_one(seed):
    """At small errors M = -k_R e_R - k_Omega e_Omega + Omega x J Omega - J (Omega x R^T R_C Omega_C - R^T R_C dOmega_C). [tests M:eq2]

    The gains are per moment of inertia; to it comes what compensates for a disturbance.
    """
    rng = np.random.default_rng(seed)
    x, d = flat(rng), rng.normal(size=3)
    expected = flat_to_state(*x, mass=VEHICLE.mass)
    R_C = expected.R_WB
    R = R_C @ Rotation.from_rotvec(1e-3 * rng.normal(size=3)).as_matrix()
    w = expected.w_WB_B + 0.3 * rng.normal(size=3)
    state = tuple(float(v) for v in (*x[0], *x[1], *body(R, w)))
    _, M, _, _, _ = geometric_step(state, setpoint(x).packed, (0.0, 0.0, 0.0, *d), GAINS, FREE, J)
    E = 0.5 * (R_C.T @ R - R.T @ R_C)
    e_R, w_C, dw_C = np.array([E[2, 1], E[0, 2], E[1, 0]]), R.T @ R_C @ expected.w_WB_B, R.T @ R_C @ expected.dw_WB_B
    demand = -np.multiply(GAINS[6:9], e_R) - np.multiply(GAINS[9:12], w - w_C) - np.cross(w, w_C) + dw_C + d
    # e_R, and the reference's angular acceleration about b3, agree to second order
    np.testing.assert_allclose(np.array(M) / J, demand + np.cross(w, np.multiply(J, w)) / J, atol=2e-3 + 2e-6 * np.abs(demand).max())


@pytest.mark.parametrize("angle", [10, 60, 120, 179, 180])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (1, 1, 0)])
def test_attitude_error_turns_back_from_any_angle(angle, axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    q = Rotation.from_rotvec(np.radians(angle) * axis).as_quat()
    e = attitude_error(tuple(q), (0.0, 0.0, 0.0, 1.0))
    way = 1.0 if angle < 180 else np.sign(np.dot(e, axis))  # at 180 degrees both are as short
    np.testing.assert_allclose(e, way * 2 * np.sin(np.radians(angle) / 2) * axis, atol=1e-9)
    if angle == 10:  # the paper's e_R agrees to second order where the heading is right
        R = Rotation.from_quat(q).as_matrix()
        paper = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        np.testing.assert_allclose(e, paper, rtol=0.005, atol=1e-12)


@pytest.mark.parametrize("turned", [30, 90, 150, -120])
@pytest.mark.parametrize("tilt", [20, 100, 170])
def test_a_heading_that_is_off_does_not_turn_the_tilt_error_aside(turned, tilt):
    """The moment against e_R turns b3 to the commanded one on the shortest way, whatever the heading."""
    q = (Rotation.from_rotvec((np.radians(tilt), 0, 0)) * Rotation.from_rotvec((0, 0, np.radians(turned)))).as_quat()
    x, y, z = attitude_error(tuple(q), (0.0, 0.0, 0.0, 1.0))
    R = Rotation.from_quat(q).as_matrix()
    shortest = np.cross(R[:, 2], (0.0, 0.0, 1.0))
    motion = R @ (-x, -y, 0.0)
    np.testing.assert_allclose(motion / np.linalg.norm(motion), shortest / np.linalg.norm(shortest), atol=1e-9)
    assert np.hypot(x, y) == pytest.approx(2 * np.sin(np.radians(tilt) / 2))
    assert z == pytest.approx(2 * np.sin(np.radians(turned) / 2))


@pytest.mark.parametrize("a, h, b3", [
    ((0, 0, -9.81), (0, 1, 0), (0, 0, 1)),       # free fall: no direction
    ((0, 0, -9.81), (0, 1, 0), (0, 1, 0)),       # free fall with the body along b2_des
    ((0, 9.0, -9.81), (0, 1, 0), (0, 0, 1)),     # thrust along b2_des: no heading
    ((0, 0, -25.0), (0, 1, 0), (0, 0, 1)),       # inverted reference
    ((0, 0, -9.81 + 1e-9), (0, 1, 0), (0, 0, -1)),
])
def test_singular_cases_stay_finite(a, h, b3):
    q = Rotation.align_vectors([b3], [(0, 0, 1)])[0].as_quat()
    x = Setpoint((0.0, 0.0, 1.0), a=tuple(map(float, a)), j=(1.0, 2.0, 3.0), s=(5.0, 5.0, 5.0), h=tuple(map(float, h)))
    state = tuple(map(float, (0.1, -0.2, 1.1, 0.3, 0, -0.2, *q, 0.1, 0.2, 0.3)))
    out = GeometricController(VEHICLE, ControlGains()).step(state, x.packed, RotorEstimate((1000.0,) * 4, (1000.0,) * 4))
    for value in (out.rotor_speed, out.wrench, out.q_C, out.w_C, out.dw_C):
        assert np.isfinite(value).all()
    assert all(VEHICLE.speed_min <= s <= VEHICLE.speed_max for s in out.rotor_speed)


def test_feedback_never_turns_the_thrust_out_of_its_cone():
    """Of 40 deg, and below the weight narrower in proportion to the thrust."""
    controller, shares = GeometricController(VEHICLE, ControlGains()), []
    for seed in range(50):
        rng = np.random.default_rng(seed)
        state = tuple(float(v) for v in (*rng.normal(size=6) * 5, 0, 0, 0, 1, 0, 0, 0))
        out = controller.step(state, Setpoint((0.0, 0.0, 1.0)).packed, RotorEstimate((1260.0,) * 4, (1260.0,) * 4))
        tilt = np.arccos(Rotation.from_quat(out.q_C).as_matrix()[2, 2])
        shares.append(np.tan(tilt) / (np.tan(np.radians(40.0)) * min(out.wrench[0] / VEHICLE.mass / 9.81, 1.0)))
    assert max(shares) < 1.0 + 1e-6 and np.sum(np.array(shares) > 1.0 - 1e-6) > 5, "it leans as far as it may"


def commanded(state, reference=Setpoint((0.0, 0.0, 1.0)), **options):
    """What the law commands in an upright, or otherwise given, state: position, velocity and then the rest."""
    return GeometricController(VEHICLE, ControlGains()).step((*map(float, state),), reference.packed, RotorEstimate((1260.0,) * 4, (1260.0,) * 4), **options)


def test_the_position_feedback_is_bounded_by_what_the_vehicle_has_beside_its_weight():
    """At 100 m below its reference as at 3 m: 8 m/s^2, up or down; and in proportion to a small error."""
    thrusts = [commanded((0, 0, 1.0 - e, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0)).wrench[0] / VEHICLE.mass - 9.81 for e in (100.0, 3.0, 0.1, 0.2, -3.0)]
    assert thrusts[0] == pytest.approx(8.0, abs=0.05) == thrusts[1] and thrusts[4] == pytest.approx(-8.0, abs=0.05)
    assert 0.0 < thrusts[2] < 2.0 and thrusts[3] == pytest.approx(2.0 * thrusts[2], rel=0.1)


def test_commanded_rates_and_angular_accelerations_are_bounded():
    """A reference that turns faster than any plan may, and a snap that no rotor follows."""
    still = (0, 0, 1.0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0)
    for jerk in (50.0, 200.0, 2000.0):
        rate = np.linalg.norm(commanded(still, Setpoint((0.0, 0.0, 1.0), j=(jerk, 0.0, 0.0))).w_C)
        assert rate == pytest.approx(min(jerk / 9.81, 1.3 * VEHICLE.body_rate_max), rel=1e-3)
    for snap in (1000.0, 1e5):
        turn = np.linalg.norm(commanded(still, Setpoint((0.0, 0.0, 1.0), s=(snap, 0.0, 0.0))).dw_C)
        assert turn == pytest.approx(min(snap / 9.81, 250.0), rel=1e-3)


def test_in_the_last_moments_before_a_contact_the_feedback_does_not_turn_the_thrust():
    """It would tilt the vehicle at the contact, and hardly move it until then; along the thrust it acts as before."""
    off = (0.0, 2.0, 0.9, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0)
    outs = [commanded(off, time_to_contact=time) for time in (np.inf, 1.0, 0.35, 0.25, 0.05, 0.0, -0.1)]
    tilts = [np.degrees(np.arccos(min(Rotation.from_quat(out.q_C).as_matrix()[2, 2], 1.0))) for out in outs]
    assert tilts[0] == tilts[1] > 30.0 and tilts[1] > tilts[2] > tilts[3] > 0.5 and max(tilts[4:]) < 1e-5
    assert outs[-1].wrench[0] > VEHICLE.mass * 10.2


def test_prediction_agrees_with_the_rigid_body_model():
    """Second implementation: oracles.rigid_body, integrated in small steps."""
    rng = np.random.default_rng(3)
    R = Rotation.random(random_state=1)
    p, v, w, f = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3) * 3, np.array([0.5, 0.7, 0.6, 0.65])
    packed = packed_vehicle(VEHICLE)
    state = tuple(float(x) for x in (*p, *v, *R.as_quat(), *w))
    got = predicted(state, tuple(f), NONE, 0.02, VEHICLE.mass, J, packed[2])
    n = 2000
    for _ in range(n):
        a, dw = rigid_body.accelerations(VEHICLE, R.as_matrix(), w, f)
        h = 0.02 / n
        p, v, R, w = p + v * h + a * h * h / 2, v + a * h, R * Rotation.from_rotvec(w * h), w + dw * h
    # Exact to second order in the duration: |jerk| h^3 / 6 is 0.1 mm here.
    np.testing.assert_allclose(got[0:3], p, atol=1e-4)
    np.testing.assert_allclose(got[3:6], v, atol=2e-3)
    assert (Rotation.from_quat(got[6:10]).inv() * R).magnitude() < 2e-3
    np.testing.assert_allclose(got[10:13], w, atol=5e-2)


def test_leading_command_reaches_the_thrust_in_time_and_reachable_says_when_it_cannot():
    k, tau, lead = VEHICLE.thrust_coefficient, VEHICLE.motor_time_constant, 0.02
    share = 1 - np.exp(-lead / tau)
    speed = (1200.0, 1250.0, 1300.0, 1260.0)
    low, high = reachable(speed, share, VEHICLE.speed_min, VEHICLE.speed_max)
    wanted = tuple(k * (0.7 * a + 0.3 * b) ** 2 for a, b in zip(low, high))
    command = leading_command(speed, wanted, k, share, VEHICLE.speed_min, VEHICLE.speed_max)
    after = np.array(speed)
    for _ in range(1000):  # the plant's own integration of the lag
        after = after + (np.array(command) - after) * (1 - np.exp(-lead / 1000 / tau))
    np.testing.assert_allclose(thrusts(tuple(after), k), wanted, rtol=1e-9)
    fastest = leading_command(speed, (10.0,) * 4, k, share, VEHICLE.speed_min, VEHICLE.speed_max)
    assert fastest == (VEHICLE.speed_max,) * 4
    np.testing.assert_allclose(high, np.array(speed) + (VEHICLE.speed_max - np.array(speed)) * share)


def test_compiled_and_plain_code_agree():
    rng = np.random.default_rng(0)
    for _ in range(50):
        x = flat(rng)
        state = tuple(float(v) for v in (*rng.normal(size=6), *Rotation.random(random_state=rng.integers(1000)).as_quat(), *rng.normal(size=3)))
        args = state, setpoint(x).packed, NONE, GAINS, (8.0, 0.8, 0.8, 18.0, 250.0), J
        for a, b in zip(geometric_step(*args), geometric_step.py_func(*args)):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_sampled_reference_gives_the_flat_references_setpoints():
    """A flat trajectory turned into full states and back: position to snap, and an equivalent b2_des."""
    rng = np.random.default_rng(5)
    trajectory = FlatTrajectory(np.array([2.0]), np.cumsum(rng.normal(size=(1, 4, 9)) * 0.3, axis=-1))
    times = np.linspace(0, 2, 401)
    states = [flat_to_state(x.p, x.v, x.a, x.j, x.s, x.yaw, x.yaw_rate, x.yaw_acc, VEHICLE.mass)
              for x in map(trajectory.sample, times)]
    sampled = SampledTrajectory(
        times, np.array([s.p_WB for s in states]), Rotation.from_matrix([s.R_WB for s in states]).as_quat(),
        np.array([s.v_WB for s in states]), np.array([s.w_WB_B for s in states]),
        trajectory.sample_many(times).a, np.array([s.dw_WB_B for s in states]),
        np.array([np.full(4, s.thrust / 4) for s in states]))
    a, b = FlatReference(trajectory), SampledReference(sampled, VEHICLE.mass)
    for t in (0.4, 1.0, 1.55):
        x, y = a.setpoint(t), b.setpoint(t)
        for key, tolerance in (("p", 1e-6), ("v", 1e-6), ("a", 1e-4), ("j", 2e-2)):
            np.testing.assert_allclose(getattr(y, key), getattr(x, key), atol=tolerance, err_msg=key)
        f = np.array(x.a) + (0, 0, 9.81)
        np.testing.assert_allclose(np.cross(np.cross(x.h, f), np.cross(y.h, f)), 0.0, atol=1e-2)


def test_setpoints_of_full_states_are_their_states_and_hold_the_last_acceleration():
    """Between unevenly spaced samples, against so3 and finite differences of the attitude."""
    rng = np.random.default_rng(4)
    times = np.array([0.0, 0.05, 0.12, 0.2])
    p, v, w, a, dw = rng.normal(size=(5, 4, 3))
    x = SampledTrajectory(times, p, Rotation.random(4, random_state=4).as_quat(), v, w, a, dw, rng.uniform(1.0, 3.0, (4, 4)))
    source = SampledReference(x, 2.0)
    for t in (0.0, 0.03, 0.05, 0.16, 0.2):
        state, found = x.sample(t), source.setpoint(t)
        R, specific = so3.quat_to_matrix(state.q), state.rotor_thrust.sum() / 2.0
        W, dW = so3.hat(state.w), so3.hat(state.dw)
        for got, wanted in ((found.p, state.p), (found.v, state.v), (found.a, specific * R[:, 2] - (0.0, 0.0, 9.81)), (found.h, R[:, 1]),
                            (found.b3, R[:, 2]), (found.dh, (R @ W)[:, 1]), (found.ddb3, (R @ (W @ W + dW))[:, 2])):
            np.testing.assert_allclose(got, wanted, atol=1e-9)
    end, after = source.setpoint(0.2), source.setpoint(0.3)
    np.testing.assert_allclose(after.v, np.add(end.v, 0.1 * np.array(end.a)), atol=1e-9)
    np.testing.assert_allclose(after.p, np.array(end.p) + 0.1 * np.array(end.v) + 0.005 * np.array(end.a), atol=1e-9)
    assert after.a == end.a and np.abs(after.dh).max() == np.abs(after.ddb3).max() == 0.0
    np.testing.assert_allclose(packed_many(source, times), [source.setpoint(t).packed for t in times], atol=1e-9)


def test_many_setpoints_are_the_single_ones():
    rng = np.random.default_rng(1)
    source = FlatReference(FlatTrajectory(np.array([0.6, 0.9]), rng.normal(size=(2, 4, 8))))
    times = np.array([0.0, 0.3, 0.59, 0.7, 1.2, 1.5, 1.6])
    np.testing.assert_allclose(packed_many(source, times), [source.setpoint(t).packed for t in times], atol=1e-9)


def test_a_carried_attitude_is_flown_where_the_force_shows_none():
    """Turning upside down in near free fall: position errors of centimetres must not choose the attitude."""
    rate = 5.0
    for angle in (1.2, 2.0, 3.0):
        R = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        b3, db3 = R[:, 2], rate * R[:, 0]
        specific = 0.3
        a = specific * b3 - (0, 0, 9.81)
        reference = Setpoint((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), tuple(a), h=(0.0, 1.0, 0.0), b3=tuple(b3), db3=tuple(db3),
                             ddb3=tuple(-rate**2 * b3))
        q = Rotation.from_matrix(R).as_quat()
        state = (0.04, -0.03, 0.05, 0.1, 0.0, -0.1, *q, 0.0, rate, 0.0)
        args = tuple(map(float, state)), reference.packed, NONE, GAINS, (8.0, 0.84, 0.8, 18.0, 250.0), J
        thrust, M, q_C, w_C, _ = geometric_step(*args)
        off = (Rotation.from_quat(q_C).inv() * Rotation.from_quat(q)).magnitude()
        assert np.degrees(off) < 4.0
        np.testing.assert_allclose(w_C, (0.0, rate, 0.0), atol=0.3)
        for got, plain in zip(geometric_step(*args), geometric_step.py_func(*args)):
            np.testing.assert_allclose(got, plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("angle", [0.5, 1.6, 2.4])
def test_rates_are_the_references_however_much_thrust_the_feedback_takes_away(angle):
    """Too slow towards an overhanging surface: the feedback leaves a fifth of the thrust, and the turn goes on as planned."""
    rate = 5.0
    R = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
    b3, db3 = R[:, 2], rate * R[:, 0]
    reference = Setpoint((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), tuple(3.3 * b3 - (0, 0, 9.81)), tuple(3.3 * db3), tuple(-3.3 * rate**2 * b3))
    gains = (7.0,) * 3 + (4.5,) * 3 + GAINS[6:]  # equal on all axes: the feedback is along b3
    for slow in (-0.4, 0.0, 0.5):
        state = tuple(map(float, (0.0, 0.0, 0.0, *(slow * b3), *Rotation.from_matrix(R).as_quat(), 0.0, rate, 0.0)))
        thrust, _, _, w_C, dw_C = geometric_step(state, reference.packed, NONE, gains, (8.0, 0.84, 0.8, 18.0, 250.0), J)
        assert thrust == pytest.approx(3.3 - 4.5 * slow)
        np.testing.assert_allclose(w_C, (0.0, rate, 0.0), atol=1e-6)
        np.testing.assert_allclose(dw_C, 0.0, atol=1e-5)


def test_a_small_thrust_is_not_turned_far_for_what_it_cannot_do():
    """5 cm and 0.1 m/s beside an overhanging surface at 3.3 m/s^2: the plan's attitude is what must not be given up."""
    R = Rotation.from_rotvec([0.0, 2.3, 0.0])
    b3 = R.as_matrix()[:, 2]
    reference = Setpoint((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), tuple(3.3 * b3 - (0, 0, 9.81)))
    state = tuple(map(float, (0.0, 0.05, 0.0, 0.0, 0.1, 0.0, *R.as_quat(), 0.0, 0.0, 0.0)))
    q_C = geometric_step(state, reference.packed, NONE, GAINS, (8.0, float(np.tan(np.radians(10.0))), 0.8, 18.0, 250.0), J)[2]
    assert np.degrees((Rotation.from_quat(q_C).inv() * R).magnitude()) < 4.0


def test_a_carried_attitude_changes_nothing_where_the_force_shows_it():
    rng, compared = np.random.default_rng(3), 0
    for _ in range(20):
        x = flat(rng)
        plain = setpoint(x)
        f = np.array(plain.a) + (0, 0, 9.81)
        if np.linalg.norm(f) < 9.81:  # below the weight the cone is narrower
            continue
        b3 = f / np.linalg.norm(f)
        db3 = (np.array(plain.j) - b3 * (b3 @ plain.j)) / np.linalg.norm(f)
        state = tuple(map(float, (*plain.p, *plain.v, *Rotation.align_vectors([b3], [[0, 0, 1]])[0].as_quat(), 0, 0, 0)))
        carried = Setpoint(plain.p, plain.v, plain.a, plain.j, plain.s, plain.h, plain.dh, plain.ddh, tuple(b3), tuple(db3))
        for a, b in zip(geometric_step(state, plain.packed, NONE, GAINS, FREE, J)[0:4:2],
                        geometric_step(state, carried.packed, NONE, GAINS, FREE, J)[0:4:2]):
            np.testing.assert_allclose(a, b, atol=1e-9)
        compared += 1
    assert compared > 5


def test_a_contact_whose_simulation_has_no_result_is_refused():
    """Thrust along the heading b2 determines no attitude."""
    c = np.zeros((1, 4, 3))
    c[0, 1, 2], c[0, 2, 2] = 0.5 * 5.0, -0.5 * 9.81
    with pytest.raises(TrajectoryRefused, match="misses the contact"):
        GeometricController(VEHICLE, VEHICLE.gains).check_contact(FlatReference(FlatTrajectory(np.ones(1), c)))
