"""An inspection that was flown, from its trace or its recording, judged."""

from __future__ import annotations

import numpy as np

from perch_eval.flight import Flight
from perch_eval.inspection.measures import Inspected, inspected
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario

EVERY = 5  # true states are judged at 100 Hz


def recorded(flight: Flight, scenario: Scenario, message: str = "") -> Inspected | None:
    """The last trajectory of a flight as an inspection; None where none was flown, or a cable sags (the measures are those of lines).

    Args:
        flight: what was flown.
        scenario: where the lines truly are.
        message: why it ended early, where that was no collision.
    """
    if scenario.mode != "inspection" or any(cable.sag > 0.0 for cable in scenario.world.cables):
        return None
    truth, orders = flight.states("ground_truth/odometry"), flight.values("trajectory")
    if truth is None or not orders:
        return None
    way = orders[-1][1].trajectory
    during = (truth.t >= way.start_time) & (truth.t <= way.start_time + way.duration)
    states = np.column_stack([truth.p, truth.q])[during][::EVERY]
    if len(states) < 2:
        return None
    crashes = [c for _, c in flight.values("contact") if c.state == ContactState.COLLISION]
    return inspected(scenario, truth.t[during][::EVERY] - way.start_time, states, len(crashes),
                     "; ".join(c.reason for c in crashes) or message)
