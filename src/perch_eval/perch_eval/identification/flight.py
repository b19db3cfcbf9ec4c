"""Flight for identification: a hover, then short moves along each axis and turns, at rest in between."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np

from perch_control.modes import State
from perch_core.errors import PerchError
from perch_core.trajectory import rest_to_rest
from perch_eval.flight import Flight
from perch_eval.scripted_flight import LEAD, ScriptedFlight
from perch_sim.scenario import Scenario

HEIGHT = 1.5                                       # of the hover [m]
MOVES = (((0.8, 0.0, 0.0), 0.0, 0.9), ((0.0, 0.8, 0.0), 0.0, 0.9), ((0.0, 0.0, 0.6), 0.0, 0.8), ((0.0, 0.0, 0.0), 1.2, 0.8),
         ((1.5, 0.0, 0.4), -0.8, 1.3), ((0.0, -1.2, -0.3), 0.8, 1.1))
"""(Offset [m], turn [rad], duration [s]) of each move, which is flown there and back."""
ROUNDS = 2                                         # all of them
PAUSE = 0.3                                        # between them [s]


def fly(scenario: Scenario, vehicle: str, seed: int, stretch: float = 1.0) -> Flight:
    """Fly in the simulator with estimated state and without L1, as its corrections depend on the response to be identified.

    Args:
        scenario: the world, and the differences of the true vehicle from its file.
        vehicle: name or file of the vehicle that the controller assumes.
        seed: seed of all random draws.
        stretch: factor of the moves' durations, above 1 if less thrust is available.

    Raises:
        PerchError: the controller leaves its hover: the vehicle does not fly with this file.
    """
    flight = ScriptedFlight(replace(scenario, vehicle=vehicle), seed, without=("powerline_mapper", "perching_planner", "powerline_planner"))
    mission, controller = flight.mission, flight.controller.flight
    controller.compensator = None
    with closing(flight.loop):
        flight.run(flight.arm() + 0.1)
        place, yaw = mission.p_WB, 0.0
        for offset, turn, duration in (((0.0, 0.0, HEIGHT), 0.0, 2.5), *(
                (sign * np.array(offset), sign * turn, stretch * T) for offset, turn, T in ROUNDS * MOVES for sign in (1.0, -1.0))):
            mission.follow(rest_to_rest(place, place + offset, yaw, yaw + turn, duration, mission.time + LEAD))
            place, yaw = place + offset, yaw + turn
            flight.run(flight.time + duration + LEAD + PAUSE)
            if controller.state is not State.HOVERING:
                raise PerchError(f"the vehicle does not fly by its file: {controller.flown.message}; correct its mass or its lags")
    return flight.loop.trace.flight
