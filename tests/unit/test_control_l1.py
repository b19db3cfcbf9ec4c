"""The L1 augmentation's estimate against the closed form of its adaptation and its filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from perch_control.l1 import L1Augmentation
from perch_core.vehicle import load_vehicle

VEHICLE = replace(load_vehicle("snapdragon"), drag=(0.0, 0.0, 0.0))
SPEED = (float(np.sqrt(VEHICLE.hover_thrust / 4 / VEHICLE.thrust_coefficient)),) * 4
ACTS = np.array([1.0, -2.0, 3.0, 0.0, 0.0, 5.0])
"""Disturbance: acceleration in W, and angular acceleration about b3, which tilts nothing. [m/s^2, rad/s^2]"""


def estimates(l1: L1Augmentation, period: float, count: int, acts: np.ndarray = ACTS) -> np.ndarray:
    """Estimate in each period from the sample on at which the disturbance begins to act on a vehicle in hover, shape (count + 1, 6)."""
    found = []
    for t in period * np.arange(count + 1):
        v, w, yaw = acts[:3] * t, acts[3:] * t, acts[5] * t**2 / 2
        l1.update((0.0, 0.0, 0.0, *map(float, v), 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)), *map(float, w)), SPEED, float(t))
        found.append(l1.disturbance)
    return np.array(found)


@pytest.mark.parametrize("period", [0.002, 0.01, 0.05])
def test_without_its_filter_the_estimate_is_the_disturbance_times_the_decay_of_a_period(period):
    found = estimates(L1Augmentation(VEHICLE, bandwidth=1e9), period, 30)
    np.testing.assert_allclose(found[1], 10.0 * period / np.expm1(10.0 * period) * ACTS, rtol=1e-6)  # of the first period's error
    np.testing.assert_allclose(found[-1], np.exp(-10.0 * period) * ACTS, rtol=1e-6)


@pytest.mark.parametrize("bandwidth", [15.0, 40.0])
def test_the_filtered_estimate_answers_a_step_as_a_low_pass_of_its_bandwidth(bandwidth):
    found = estimates(L1Augmentation(VEHICLE, bandwidth), 0.002, 150)
    rise = -np.expm1(-bandwidth * 0.002 * np.arange(151))
    np.testing.assert_allclose(found, np.exp(-0.02) * rise[:, None] * ACTS, atol=0.01)


def test_of_a_disturbance_beyond_reason_no_more_is_made_up_for_than_the_vehicle_can():
    """6 m/s^2 and 60 rad/s^2, in its direction; the estimate returns as fast as from a smaller one when it ends."""
    l1, strong = L1Augmentation(VEHICLE, bandwidth=40.0), 20.0 * ACTS
    found = estimates(l1, 0.002, 150, strong)
    np.testing.assert_allclose(found[-1], [*(6.0 * ACTS[:3] / np.linalg.norm(ACTS[:3])), 0.0, 0.0, 60.0], rtol=1e-6, atol=1e-9)
    assert np.linalg.norm(found[:, :3], axis=1).max() < 6.0 + 1e-9


@pytest.mark.parametrize("gap, believed", [(0.05, True), (0.07, False)])
def test_what_happens_while_no_samples_come_is_no_disturbance(gap, believed):
    """A vehicle that is seen again after a gap may have been struck meanwhile: the estimate stays, and goes on from there."""
    l1, still = L1Augmentation(VEHICLE), (0.0,) * 9 + (1.0,) + (0.0,) * 3
    for k in range(30):
        l1.update(still, SPEED, 0.002 * k)
    struck = (0.0, 0.0, 0.0, 1.0, *still[4:])
    for time in (0.058 + gap, 0.060 + gap, 0.062 + gap):
        l1.update(struck, SPEED, time)
    assert (l1.disturbance[0] > 1.0) is believed and (believed or abs(l1.disturbance[0]) < 1e-6)
