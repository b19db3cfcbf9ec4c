"""Flights whose goal is cancelled at a given time before the planned contact, and their ends."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

import numpy as np

from perch_core.values import NANOSECONDS, ControllerStatus, PerchResult, seconds
from perch_control.modes import State
from perch_eval.ending import simulated_ending
from perch_eval.goal import goal_of
from perch_eval.in_process import Sensing, arrange
from perch_sim.scenario import load_scenario

LIMIT = 60 * NANOSECONDS   # for the whole flight [ns]
LINGER = NANOSECONDS // 2  # flown on after the goal's end [ns]


@dataclass(frozen=True)
class CancelledFlight:
    """Result of one flight.

    Attributes:
        scenario, seed: name of the scenario, and seed of the flight.
        before: time of the cancellation before the planned contact [s].
        planned: whether the vehicle left the plan by a planned way out.
        end: true end, `attached` on the target, or that it was never cancelled.
        perched: whether the mission reports a perch: the goal was cancelled too late.
        message: message of the mission's result.
        rate: largest body rate after the cancellation [rad/s].
        margin: least thrust margin of the controller after the cancellation.
        distance: least distance of the centre of mass from the surface's plane after it [m]; meaningless with wires.
        settled: time from the cancellation to the goal's end [s].
    """

    scenario: str
    seed: int
    before: float
    planned: bool
    end: str
    perched: bool
    message: str
    rate: float
    margin: float
    distance: float
    settled: float


def fly_cancelled(scenario: str, seed: int, before: float) -> CancelledFlight:
    """Fly a scenario and cancel its goal `before` seconds ahead of the planned contact.

    Raises:
        PerchError: the scenario is invalid.
    """
    loaded = load_scenario(scenario)
    with closing(arrange(loaded, seed, Sensing())) as loop:
        goal, simulation = loop.send("mission", goal_of(loaded)), loop.vehicle.simulation
        stamp, cancelled, ended = 0, 0, 0
        rate, distance = 0.0, np.inf
        while stamp < LIMIT and not (ended and stamp - ended > LINGER):
            stamp = loop.step()
            if not cancelled:
                for order in loop.trace.values("trajectory")[-1:]:
                    if order.contact_after is not None and order.trajectory.start_time + order.contact_after - seconds(stamp) <= before:
                        cancelled, goal.cancel_requested = stamp, True
            else:
                x, pad = simulation.state, simulation.pad
                rate = max(rate, float(np.linalg.norm(x.w_WB_B)))
                distance = min(distance, float((x.p_WB - pad.p_WS) @ pad.normal))
                ended = ended or (stamp if goal.result is not None else 0)
    statuses: list[ControllerStatus] = [s for s in loop.trace.values("controller/status") if s.stamp >= cancelled]
    end = simulated_ending(simulation, State(statuses[-1].state)) if cancelled else "never cancelled"
    end = "attached" if end == "perched" else end  # `perched` is what the mission reports
    result = goal.result or PerchResult(False, 0, "no end")
    return CancelledFlight(scenario, seed, before, any("as planned" in s.message for s in statuses), end, bool(np.isfinite(result.contact_time)),
                           result.message, rate, min(s.thrust_margin for s in statuses), distance,
                           seconds(max(ended, cancelled) - cancelled))
