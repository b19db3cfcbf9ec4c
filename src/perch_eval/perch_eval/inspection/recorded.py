"""A recorded inspection, judged."""

from __future__ import annotations

import numpy as np

from perch_core.ros.trajectories import from_message
from perch_core.scenario import Scenario
from perch_eval.flight import Flight
from perch_eval.inspection.measures import Inspected, inspected

EVERY = 5  # true states are judged at 100 Hz
COLLISION = 3  # perch_msgs/Contact


def recorded(flight: Flight, scenario: Scenario) -> Inspected | None:
    """The last trajectory of a flight as an inspection; None where none was flown, or a cable sags (the measures are those of lines)."""
    if scenario.mode != "inspection" or any(cable.sag > 0.0 for cable in scenario.world.cables):
        return None
    truth, orders = flight.states("ground_truth/odometry"), flight.messages("trajectory")
    if truth is None or not orders:
        return None
    way = from_message(orders[-1][1])
    during = (truth.t >= way.start_time) & (truth.t <= way.start_time + way.duration)
    states = np.column_stack([truth.p, truth.q])[during][::EVERY]
    if len(states) < 2:
        return None
    crashes = [m for _, m in flight.messages("contact") if m.state == COLLISION]
    return inspected(scenario, truth.t[during][::EVERY] - way.start_time, states, len(crashes), "; ".join(m.reason for m in crashes))
