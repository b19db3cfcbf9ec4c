"""Rotations against scipy and against finite differences."""

import numpy as np
from hypothesis import assume, given, strategies as st
from scipy.spatial.transform import Rotation

from perch_core import so3

angles = st.floats(0.0, np.pi - 1e-4)
axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)


def rotvec(axis, angle):
    return np.array(axis) / np.linalg.norm(axis) * angle


@given(axes, angles)
def test_exp_and_log_agree_with_scipy(axis, angle):
    phi = rotvec(axis, angle)
    R = Rotation.from_rotvec(phi)
    assert np.allclose(so3.exp(phi), R.as_matrix(), rtol=0.0, atol=1e-12)
    assert np.allclose(so3.log(R.as_matrix()), phi, rtol=0.0, atol=1e-7)
    assert np.allclose(so3.quat_exp(phi), R.as_quat(canonical=True), rtol=0.0, atol=1e-12)


@given(axes, st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 9e-7, 1.1e-6, 1e-4, 9e-3, 1.1e-2]))
def test_small_angles_keep_precision(axis, angle):
    phi = rotvec(axis, angle)
    assert np.allclose(so3.quat_log(so3.quat_exp(phi)), phi, rtol=1e-9, atol=1e-16)
    assert np.allclose(so3.exp(phi), Rotation.from_rotvec(phi).as_matrix(), rtol=0.0, atol=1e-15)


@given(axes)
def test_half_turns(axis):
    R = Rotation.from_rotvec(rotvec(axis, np.pi)).as_matrix()
    assert np.allclose(so3.exp(so3.log(R)), R, rtol=0.0, atol=1e-7)


@given(axes, angles, axes, angles)
def test_quaternions_compose_like_matrices(a, alpha, b, beta):
    qa, qb = so3.quat_exp(rotvec(a, alpha)), so3.quat_exp(rotvec(b, beta))
    v = np.array([0.3, -1.2, 2.0])
    Ra, Rb = so3.quat_to_matrix(qa), so3.quat_to_matrix(qb)
    assert np.allclose(so3.quat_to_matrix(so3.quat_multiply(qa, qb)), Ra @ Rb, rtol=0.0, atol=1e-12)
    assert np.allclose(so3.quat_rotate(qa, v), Ra @ v, rtol=0.0, atol=1e-12)
    assert np.allclose(so3.quat_multiply(qa, so3.quat_conjugate(qa)), [0, 0, 0, 1], rtol=0.0, atol=1e-12)


@given(axes, angles, axes, angles, st.floats(0.0, 1.0))
def test_between_two_rotations_is_an_even_turn_the_shorter_way(a, alpha, b, beta, share):
    qa, qb = so3.quat_exp(rotvec(a, alpha)), so3.quat_exp(rotvec(b, beta))
    turn = (Rotation.from_quat(qa).inv() * Rotation.from_quat(qb)).as_rotvec()
    assume(np.linalg.norm(turn) < np.pi - 1e-3)  # both ways are as short
    left = Rotation.from_quat(so3.quat_slerp(qa, qb, share)).inv() * Rotation.from_quat(qa) * Rotation.from_rotvec(share * turn)
    assert left.magnitude() < 1e-7


def test_hat_is_the_cross_product():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 5, 3))
    assert np.allclose(np.einsum("nij,nj->ni", so3.hat(a), b), np.cross(a, b), rtol=0.0, atol=1e-14)


def test_vector_products_have_the_bits_of_numpy():
    rng = np.random.default_rng(7)
    for a, b in (((3,), (3,)), ((50, 3), (50, 3)), ((3,), (50, 3)), ((9, 1, 3), (9, 4, 3))):
        a, b = rng.normal(size=a), rng.normal(size=b)
        assert so3.cross(a, b).tobytes() == np.cross(a, b).tobytes()


def test_yaw_survives_a_pitch_to_90_degrees():
    for yaw in (-2.0, 0.3, 3.0):
        for pitch in (0.0, -np.pi / 2, -1.0):
            R = Rotation.from_euler("ZY", [yaw, pitch]).as_matrix()
            assert np.isclose(np.angle(np.exp(1j * (so3.yaw_of(R) - yaw))), 0.0, atol=1e-12)


def test_angle_between_is_accurate_at_both_ends():
    e = np.array([0.0, 0.0, 1.0])
    for angle in (0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9):
        other = np.array([np.sin(angle), 0.0, np.cos(angle)])
        assert np.isclose(so3.angle_between(e, other), angle, rtol=1e-6, atol=1e-15)
