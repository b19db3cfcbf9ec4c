"""Prioritised allocation against a general linear-programming solver."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from perch_control.allocation import allocate, mixing_columns
from perch_core.vehicle import load_vehicle

VEHICLES = {name: load_vehicle(name) for name in ("snapdragon", "rpg")}
many = settings(max_examples=150)


def lexicographic(B, wrench, lo, hi, tilt0):
    """The same priorities by three linear programs in the rotor thrusts: tilt share, thrust, yaw."""
    step = np.array(wrench[1:3]) - tilt0

    def solve(cost, equal, right):
        result = linprog(cost, A_eq=equal, b_eq=right, bounds=[*zip(lo, hi), (0, 1), (0, None)], method="highs")
        assert result.status == 0, result.message
        return result.x

    tilt_rows = np.column_stack([B[1:3], -step, np.zeros(2)])
    s = solve([0, 0, 0, 0, -1, 0], tilt_rows, tilt0)[4]
    fixed = np.vstack([tilt_rows, [0, 0, 0, 0, 1, 0]]), np.append(tilt0, s)
    values = [s]
    for row, wanted in ((0, wrench[0]), (3, wrench[3])):
        best = None
        for sign in (1.0, -1.0):  # distance above or below the wanted value
            equal = np.vstack([fixed[0], np.append(B[row], [0, -sign])])
            result = linprog([0, 0, 0, 0, 0, 1], A_eq=equal, b_eq=np.append(fixed[1], wanted),
                             bounds=[*zip(lo, hi), (0, 1), (0, None)], method="highs")
            if result.status == 0 and (best is None or result.x[5] < best[1]):
                best = wanted + sign * result.x[5], result.x[5]
        values.append(best[0])
        fixed = np.vstack([fixed[0], np.append(B[row], [0, 0])]), np.append(fixed[1], best[0])
    return values


@many
@given(st.sampled_from(sorted(VEHICLES)), st.integers(0, 2**31 - 1), st.booleans())
def test_priorities_agree_with_linear_programs(name, seed, lagging):
    vehicle = VEHICLES[name]
    rng = np.random.default_rng(seed)
    B, top = vehicle.allocation, vehicle.thrust_max
    lo, hi = np.full(4, vehicle.thrust_min), np.full(4, top)
    tilt0 = np.zeros(2)
    if lagging:  # bounds of rotors that can only change so fast
        now = rng.uniform(lo, hi)
        lo, hi = np.maximum(lo, now - 0.2 * top * rng.random(4)), np.minimum(hi, now + 0.2 * top * rng.random(4))
        tilt0 = (B @ now)[1:3]
    wrench = np.array([rng.uniform(-0.5, 5) * top, *rng.normal(size=3) * top * (0.2, 0.2, 0.03)])
    f = np.array(allocate(tuple(wrench), tuple(tilt0), tuple(lo), tuple(hi), mixing_columns(vehicle)))
    assert np.all(f >= lo - 1e-12) and np.all(f <= hi + 1e-12)
    s, thrust, yaw = lexicographic(B, wrench, lo, hi, tilt0)
    got = B @ f
    scale = top * 1e-6
    np.testing.assert_allclose(got[1:3], tilt0 + s * (wrench[1:3] - tilt0), atol=scale)
    assert got[0] == pytest.approx(thrust, abs=10 * scale)
    assert got[3] == pytest.approx(yaw, abs=10 * scale)


@many
@given(st.integers(0, 2**31 - 1))
def test_a_wrench_within_the_limits_is_had_exactly(seed):
    vehicle = VEHICLES["snapdragon"]
    f = np.random.default_rng(seed).uniform(vehicle.thrust_min, vehicle.thrust_max, 4)
    lo, hi = (vehicle.thrust_min,) * 4, (vehicle.thrust_max,) * 4
    got = allocate(tuple(vehicle.allocation @ f), (0.0, 0.0), lo, hi, mixing_columns(vehicle))
    np.testing.assert_allclose(got, f, atol=1e-9)


def test_yaw_goes_first_then_thrust_then_tilt():
    vehicle = VEHICLES["snapdragon"]
    lo, hi, B = (vehicle.thrust_min,) * 4, (vehicle.thrust_max,) * 4, vehicle.allocation
    def had(wrench):
        return B @ np.array(allocate(wrench, (0.0, 0.0), lo, hi, mixing_columns(vehicle)))
    np.testing.assert_allclose(had((2.5, 0.05, 0.0, 0.05))[:3], (2.5, 0.05, 0.0), atol=1e-9)
    assert had((2.5, 0.05, 0.0, 0.05))[3] < 0.04, "yaw was given up"
    full = had((4.5, 0.05, 0.0, 0.0))
    assert full[0] < 4.5 and full[1] == pytest.approx(0.05), "thrust was given up for tilt"
    beyond = had((2.5, 0.5, 0.0, 0.0))
    assert 0.1 < beyond[1] < 0.5 and abs(beyond[2]) < 1e-9, "as much tilt as there is, in its direction"


def test_compiled_and_plain_code_agree():
    vehicle = VEHICLES["snapdragon"]
    rng = np.random.default_rng(0)
    lo, hi = (vehicle.thrust_min,) * 4, (vehicle.thrust_max,) * 4
    for _ in range(100):
        wrench = tuple(float(x) for x in rng.normal(size=4) * (3, 0.2, 0.2, 0.05) + (2, 0, 0, 0))
        args = wrench, (0.0, 0.0), lo, hi, mixing_columns(vehicle)
        np.testing.assert_allclose(allocate(*args), allocate.py_func(*args), atol=1e-12)
