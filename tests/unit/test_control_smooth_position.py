"""Before a wire the controller flies on the velocity: what odometry corrects its position by is not flown after."""

from __future__ import annotations

import numpy as np
import pytest

from perch_control.admission import AtEnd, Order
from perch_control.smooth_position import CORRECTION_MAX, SmoothPosition

CONTACT = 3.0


def flown(correction, at: float, at_end: AtEnd = AtEnd.RECOVER, recovery_start: float = 2.0, end: float = 4.0) -> np.ndarray:
    """Positions that are flown on, shape (n, 3), less the true ones: odometry jumps by `correction` (3,) at a time."""
    smooth, order, off = SmoothPosition(), Order(1, None, 1.0, at_end, 0.25, recovery_start), []
    for k in range(round(500 * end)):
        time = 0.002 * k
        p, v = np.array([np.sin(time), 0.5 * time**2, 1.0]), np.array([np.cos(time), time, 0.0])
        seen = p + np.array(correction) * (time >= at)
        state = smooth.state(time, (*seen.tolist(), *v.tolist(), 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), order if time >= 1.0 else None)
        off.append(np.array(state[:3]) - p)
    return np.array(off)


@pytest.mark.parametrize("at", [CONTACT - 0.1, CONTACT + 0.1])
def test_a_correction_at_the_wire_is_left_out_until_the_trajectory_ends(at):
    off = flown([-0.03, 0.0, 0.01], at)
    assert np.abs(off).max() < 1e-5


@pytest.mark.parametrize("case", [{"at": CONTACT - 0.3}, {"at": CONTACT + 0.5}, {"at": CONTACT - 0.1, "at_end": AtEnd.HOLD},
                                  {"at": CONTACT - 0.1, "at_end": AtEnd.CONTACT}, {"at": CONTACT - 0.1, "recovery_start": -1.0}])
def test_elsewhere_the_odometry_is_believed(case):
    np.testing.assert_allclose(flown([-0.03, 0.0, 0.01], **case)[-1], [-0.03, 0.0, 0.01], atol=1e-5)


def test_odometry_that_was_wrong_altogether_is_believed():
    np.testing.assert_allclose(flown([0.0, 0.0, 2.0 * CORRECTION_MAX], CONTACT - 0.1)[-1], [0.0, 0.0, 2.0 * CORRECTION_MAX], atol=1e-5)


def test_the_next_trajectory_is_flown_on_the_odometry_as_it_is():
    smooth, seen = SmoothPosition(), (0.0,) * 6 + (0.0, 0.0, 0.0, 1.0) + (0.0,) * 3
    moved = (0.02,) + seen[1:]
    for time, sample in ((2.9, seen), (2.902, seen), (2.904, moved)):
        state = smooth.state(time, sample, Order(1, None, 1.0, AtEnd.RECOVER, 0.25, 2.0))
    assert state[0] == 0.0
    assert smooth.state(2.906, moved, Order(1, None, 2.9, AtEnd.HOLD))[0] == 0.02
