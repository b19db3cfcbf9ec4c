"""Prioritised allocation against general solvers: least squares with bounds for the tilt, linear programs for the rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, lsq_linear

from perch_control.allocation import allocate, mixing_columns
from perch_core.vehicle import load_vehicle

VEHICLES = {name: load_vehicle(name) for name in ("snapdragon", "rpg")}
many = settings(max_examples=150)


def lexicographic(B, wrench, lo, hi, free):
    """The same priorities by general solvers: nearest tilt to what free rotors have in its direction, thrust, yaw."""
    share = linprog([0, 0, 0, 0, -1], A_eq=np.column_stack([B[1:3], -np.array(wrench[1:3])]), b_eq=np.zeros(2),
                    bounds=[free] * 4 + [(0, 1)], method="highs").x[4]
    tilt = B[1:3] @ lsq_linear(B[1:3] / 1e-3, share * np.array(wrench[1:3]) / 1e-3, (lo, hi + 1e-12), method="bvls", tol=1e-14).x
    values, rows, right = [tilt], B[1:3], tilt
    for row, wanted in ((0, wrench[0]), (3, wrench[3])):
        best = None
        for sign in (1.0, -1.0):  # distance above or below the wanted value
            equal = np.vstack([np.column_stack([rows, np.zeros(len(rows))]), np.append(B[row], -sign)])
            result = linprog([0, 0, 0, 0, 1], A_eq=equal, b_eq=np.append(right, wanted),
                             bounds=[*zip(lo - 1e-9, hi + 1e-9), (0, None)], method="highs")
            if result.status == 0 and (best is None or result.x[4] < best[1]):
                best = wanted + sign * result.x[4], result.x[4]
        values.append(best[0])
        rows, right = np.vstack([rows, B[row]]), np.append(right, best[0])
    return values


def had(vehicle, wrench, lo=None, hi=None):
    """Rotor thrusts, shape (4,)."""
    floor, ceiling = vehicle.thrust_min, vehicle.thrust_max
    lo, hi = (floor,) * 4 if lo is None else tuple(lo), (ceiling,) * 4 if hi is None else tuple(hi)
    levers = tuple(tuple(float(v) for v in row) for row in vehicle.allocation[1:])
    return np.array(allocate(tuple(wrench), lo, hi, floor, ceiling, levers, mixing_columns(vehicle)))


@many
@given(st.sampled_from(sorted(VEHICLES)), st.integers(0, 2**31 - 1), st.booleans())
def test_priorities_agree_with_general_solvers(name, seed, lagging):
    vehicle = VEHICLES[name]
    rng = np.random.default_rng(seed)
    B, top = vehicle.allocation, vehicle.thrust_max
    lo, hi = np.full(4, vehicle.thrust_min), np.full(4, top)
    if lagging:  # bounds of rotors that can only change so fast
        now = rng.uniform(lo, hi)
        lo, hi = np.maximum(lo, now - 0.2 * top * rng.random(4)), np.minimum(hi, now + 0.2 * top * rng.random(4))
    wrench = np.array([rng.uniform(-0.5, 5) * top, *rng.normal(size=3) * top * (0.2, 0.2, 0.03)])
    f = had(vehicle, wrench, lo, hi)
    assert np.all(f >= lo - 1e-12) and np.all(f <= hi + 1e-12)
    tilt, thrust, yaw = lexicographic(B, wrench, lo, hi, (vehicle.thrust_min, top))
    got = B @ f
    scale = top * 1e-6
    np.testing.assert_allclose(got[1:3], tilt, atol=scale)
    assert got[0] == pytest.approx(thrust, abs=20 * scale)
    assert got[3] == pytest.approx(yaw, abs=20 * scale)


def test_a_turn_is_braked_where_two_rotors_can_go_no_further():
    """The wanted tilt moment points out of what can be reached: the others still help."""
    vehicle = VEHICLES["snapdragon"]
    now = np.array([vehicle.thrust_max, 0.61, vehicle.thrust_min, 1.02])
    lo, hi = np.maximum(vehicle.thrust_min, now - 0.15), np.minimum(vehicle.thrust_max, now + 0.15)
    f = had(vehicle, (2.0, 0.5, 0.17, 0.0), lo, hi)
    gained = (vehicle.allocation @ (f - now))[1:3]
    assert gained @ (0.5, 0.17) > 0.3 * np.linalg.norm(gained) * np.hypot(0.5, 0.17) > 0.0


@many
@given(st.integers(0, 2**31 - 1))
def test_a_wrench_within_the_limits_is_had_exactly(seed):
    vehicle = VEHICLES["snapdragon"]
    f = np.random.default_rng(seed).uniform(vehicle.thrust_min, vehicle.thrust_max, 4)
    np.testing.assert_allclose(had(vehicle, vehicle.allocation @ f), f, atol=1e-9)


def test_yaw_goes_first_then_thrust_then_tilt():
    vehicle = VEHICLES["snapdragon"]

    def wrench(*wanted):
        return vehicle.allocation @ had(vehicle, wanted)

    np.testing.assert_allclose(wrench(2.5, 0.05, 0.0, 0.05)[:3], (2.5, 0.05, 0.0), atol=1e-9)
    assert wrench(2.5, 0.05, 0.0, 0.05)[3] < 0.04, "yaw was given up"
    full = wrench(4.5, 0.05, 0.0, 0.0)
    assert full[0] < 4.5 and full[1] == pytest.approx(0.05), "thrust was given up for tilt"
    beyond = wrench(2.5, 0.5, 0.2, 0.0)
    assert 0.1 < beyond[1] < 0.5 and beyond[2] == pytest.approx(0.4 * beyond[1]), "as much tilt as there is, in its direction"


def test_compiled_and_plain_code_agree():
    vehicle = VEHICLES["snapdragon"]
    rng = np.random.default_rng(0)
    lo, hi = (vehicle.thrust_min,) * 4, (vehicle.thrust_max,) * 4
    levers = tuple(tuple(float(v) for v in row) for row in vehicle.allocation[1:])
    for _ in range(100):
        wrench = tuple(float(x) for x in rng.normal(size=4) * (3, 0.2, 0.2, 0.05) + (2, 0, 0, 0))
        args = wrench, lo, hi, lo[0], hi[0], levers, mixing_columns(vehicle)
        np.testing.assert_allclose(allocate(*args), allocate.py_func(*args), atol=1e-12)
