"""Random starts of a perch, for statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perch_core import so3
from perch_core.rotor_model import P, V, RotorModel, hover_state
from perch_core.vehicle import Vehicle
from perch_planner.powerline.problem import PowerlineProblem
from perch_planner.powerline.request import PowerlineRequest

SPREAD = np.array([0.7, 0.7, 0.4])  # half widths of the box of random starts [m]
SPREAD_YAW = np.radians(25.0)
SPREAD_SPEED = 0.2  # per axis [m/s]


def random_start(nominal: PowerlineRequest, problem: PowerlineProblem, vehicle: Vehicle, rng: np.random.Generator
                 ) -> PowerlineRequest:
    """The same perch from a start drawn around the nominal one, slowly drifting.

    Args:
        nominal: the problem's own request.
        problem: its gravity.
        vehicle: mass and rotors of the start's hover.
        rng: source of the draw.
    """
    p_WB = nominal.start[P] + rng.uniform(-1, 1, 3) * SPREAD
    yaw = so3.quat_exp(np.array([0.0, 0.0, rng.uniform(-SPREAD_YAW, SPREAD_YAW)]))
    start = hover_state(RotorModel.of(vehicle, problem.gravity), p_WB, so3.quat_multiply(yaw, nominal.start[3:7]))
    start[V] = rng.uniform(-SPREAD_SPEED, SPREAD_SPEED, 3)
    return replace(nominal, start=start)
