"""Errors at the perching point of a flown powerline perch, against a flight whose errors are known."""

import numpy as np
import pytest
from perch_msgs.msg import Contact

from perch_core import so3
from perch_core.ros.trajectories import sampled_message
from perch_core.trajectory import SampledTrajectory
from perch_eval.evaluation.powerline_flights import perching_errors
from perch_eval.flight import Flight, States

OFFSET, TILT = np.array([0.01, -0.02, 0.02]), np.radians(4.0)  # of the flown from the planned: 3 cm, 4 deg


class Flown(Flight):
    """A recorded flight made here: the plan, shifted and tilted, and flown to `end`."""

    def __init__(self, end: float, contact: float | None = None) -> None:
        times = np.linspace(0.0, 3.0, 31)
        p = np.stack([times, np.zeros(31), 2.0 + 0.1 * times], axis=1)
        q = so3.quat_exp(np.stack([np.zeros(31), 0.4 * times, np.zeros(31)], axis=1))
        zero = np.zeros((31, 3))
        plan = sampled_message(SampledTrajectory(times, p, q, np.gradient(p, times, axis=0), zero, zero, zero, np.ones((31, 4)), 10.0))
        plan.at_end, plan.recovery_start = 3, 2.0
        self._raw = {"trajectory": [(9.0, plan)]}
        if contact is not None:
            self._raw["contact"] = [(1.0, Contact(state=4)), (2.0, Contact(state=0)), (contact, Contact(state=1))]
        t = np.linspace(0.0, end - 10.0, 400)
        turn = so3.quat_exp(np.array([0.0, TILT, 0.0]))
        nearest = so3.quat_exp(np.stack([0 * t, 0.4 * t, 0 * t], axis=1))
        self._truth = States(10.0 + t, np.stack([t, 0 * t, 2.0 + 0.1 * t], axis=1) + OFFSET, so3.quat_multiply(nearest, turn),
                             np.zeros((400, 3)), np.zeros((400, 3)))

    def states(self, topic):
        return self._truth if topic == "ground_truth/odometry" else None


@pytest.mark.parametrize("contact", [None, 11.6, 12.5])
def test_errors_are_those_that_were_put_in(contact):
    found = perching_errors(Flown(12.8, contact))
    assert found["perching_position_m"] == pytest.approx(0.03, abs=1e-6)
    assert found["perching_tilt_deg"] == pytest.approx(4.0, abs=0.3)  # the attitude is that of the nearest sample


def test_a_flight_that_ends_before_the_perch_has_no_errors():
    assert perching_errors(Flown(11.5)) == {"perching_position_m": None, "perching_tilt_deg": None}
