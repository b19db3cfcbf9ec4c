"""The aggressive scenario: as fast a turn to the wall as in paper M."""

from __future__ import annotations

import numpy as np

from perch_core.flatness import flat_to_state
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState
from perch_sim.scenario import load_scenario


def largest_rate(settings: PerchSettings) -> float:
    """Of a plan from hover to a wall 1.7 m away [deg/s], sampled."""
    vehicle = load_vehicle("snapdragon")
    planned = plan(PerchProblem(StartState((0.0, 0.0, 1.2)), PerchSurface.from_inclination((1.7, 0.0, 1.2), np.radians(90.0))), settings, vehicle)
    assert all(c.holds for c in planned.certificates)
    flat = map(planned.trajectory.sample, np.arange(0.0, planned.duration, 2e-3))
    states = (flat_to_state(x.p, x.v, x.a, x.j, x.s, x.yaw, x.yaw_rate, x.yaw_acc, vehicle.mass) for x in flat)
    return float(np.degrees(max(np.linalg.norm(x.w_WB_B) for x in states)))


def test_the_aggressive_scenario_turns_to_the_wall_with_600_deg_per_s():
    """M, Fig. 6; with the impact acceleration of the other scenarios rotors have too little left to stop such a rotation."""
    settings = load_scenario("surface_90_aggressive").parameters["perching_planner"]
    assert largest_rate(PerchSettings(**settings)) > 600.0 > 1.2 * largest_rate(PerchSettings())
