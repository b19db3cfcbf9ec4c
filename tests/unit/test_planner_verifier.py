"""The independent verifier finds planted faults, and the two builds of the kernels agree."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.plan_output import requirements
from perch_planner.verifier import verify

ROOT = Path(__file__).resolve().parents[2]

VEHICLE = load_vehicle("snapdragon")
PROBLEM = PerchProblem(StartState((0.0, 0.0, 1.5)), PerchSurface.from_inclination(np.array([2.0, 0.0, 1.5]), np.radians(70.0)),
                       (Waypoint((0.7, 0.1, 1.4)),))
SETTINGS = PerchSettings()
PLAN = plan(PROBLEM, SETTINGS, VEHICLE)
NEED = requirements(PROBLEM, SETTINGS, VEHICLE)


def findings(coefficients=None, durations=None, **changes):
    found = verify(PLAN.trajectory.durations if durations is None else durations,
                   PLAN.trajectory.coefficients if coefficients is None else coefficients,
                   dataclasses.replace(NEED, **changes), step=1e-3)
    return " ".join(f.requirement for f in found)


def test_the_untouched_plan_is_accepted():
    """[tests M:eq14, M:eq15]"""
    assert findings() == ""


@pytest.mark.parametrize("changes, words", [
    ({"thrust": (0.5, 3.0)}, "thrust, greatest"), ({"thrust": (2.0, 4.5)}, "thrust, least"), ({"body_rate": 1.0}, "body rate"),
    ({"speed": 0.5}, "speed"), ({"height": (1.49, 3.0)}, "height, least"), ({"height": (0.0, 1.3)}, "height, greatest"),
    ({"extension": 2.0}, "clearance"), ({"tube": (0.15, 0.01, 0.001, 0.001)}, "tube"), ({"impact_speed": (0.7, 0.8)}, "impact speed, least"),
    ({"impact_speed": (0.1, 0.2)}, "impact speed, greatest"), ({"tangential_speed": 1e-3}, "tangential"),
    ({"impact_acceleration": 3.31}, "acceleration at contact"), ({"perch_offset": 0.05}, "position at contact"),
    ({"v_S": np.array([0.01, 0.0, 0.0])}, "position at contact"), ({"waypoints": NEED.waypoints + [[[0.0, 0.0, 0.01]]]}, "waypoint 0, derivative 0"),
    ({"waypoints": np.nan_to_num(NEED.waypoints)}, "waypoint 0, derivative 1"), ({"end_yaw": 0.1}, "heading at contact"), ({"duration": 0.5}, "duration"),
    ({"start": np.array([[0.0, 0.0, 1.5], [0.01, 0.0, 0.0], [0.0] * 3, [0.0] * 3])}, "start, derivative 1"),
    ({"start_yaw": (0.1, 0.0)}, "start yaw"),
    ({"rotors": dataclasses.replace(NEED.rotors, thrust=(0.4, 1.1))}, "rotor thrust, least"),
    ({"rotors": dataclasses.replace(NEED.rotors, thrust=(0.1, 0.7))}, "rotor thrust, greatest")])
def test_a_broken_requirement_is_found(changes, words):
    assert words in findings(**changes)


def test_the_heading_at_contact_counts_modulo_a_full_turn():
    assert findings(end_yaw=NEED.end_yaw + 2.0 * np.pi) == ""


@pytest.mark.parametrize("length, instants", [(0.12, 12), (0.105, 11), (0.004, 1)])
def test_the_tube_is_checked_at_all_its_instants(length, instants):
    """A tube of no width is left at every instant but the contact."""
    tube = (length, 0.01, 0.0, 0.0)
    assert findings(tube=tube).count("tube") == instants


def test_a_plate_behind_the_surface_is_found():
    """Onto a surface that faces up, a small impact acceleration lets the plan come from below where the clearance does."""
    problem = PerchProblem(StartState((0.0, 0.0, 1.2)), PerchSurface.from_inclination(np.array([1.7, 0.0, 0.8]), np.radians(20.0)))
    through = dataclasses.replace(SETTINGS, impact_acceleration_fixed=True, clearance_min=-0.2)
    planned = plan(problem, through, VEHICLE).trajectory
    need = dataclasses.replace(requirements(problem, through, VEHICLE), clearance=0.0, extension=0.0)
    assert {f.requirement for f in verify(planned.durations, planned.coefficients, need, step=1e-3)} >= {"plate in front of the surface"}


def test_a_contact_faster_than_its_window_is_found_where_no_speed_suits_a_late_one_too():
    """At 135 deg 0.03 s change the speed by 0.31 m/s, twice what the window is wide: the mean of both is in its middle."""
    problem = dataclasses.replace(PROBLEM, surface=PerchSurface.from_inclination(np.array([2.0, 0.0, 1.6]), np.radians(135.0)), waypoints=())
    late = dataclasses.replace(SETTINGS, contact_delay=0.03)
    speed = 0.725 + 0.5 * 0.03 * (SETTINGS.impact_acceleration + 9.81 * np.sqrt(0.5))
    fast = dataclasses.replace(late, impact_speed_min=speed, impact_speed_max=speed, contact_delay=0.0, tangential_speed_max=0.09)
    planned = plan(problem, fast, VEHICLE).trajectory
    found = verify(planned.durations, planned.coefficients, requirements(problem, late, VEHICLE), step=1e-3)
    assert [f.requirement for f in found] == ["impact speed, greatest [M:eq14]"] and found[0].excess == pytest.approx(speed - 0.8, abs=1e-6)


def test_a_tampered_coefficient_or_duration_is_found():
    for segment, row in ((0, 0), (1, 2)):
        rows = PLAN.trajectory.coefficients.copy()
        rows[segment, row, 7] += 0.02
        durations = PLAN.trajectory.durations.copy()
        durations[segment] *= 0.9
        assert "continuity" in findings(durations=durations)
        rows[segment, row, -1] += 1e-6
        assert "continuity" in findings(rows)


_PLAN_BY_INTERPRETER = """
import json
import numpy as np
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_core.jit import COMPILED
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState
surface = PerchSurface.from_inclination(np.array([1.7, 0.2, 1.5]), 1.2, 0.1)
answer = plan(PerchProblem(StartState((0.0, 0.0, 1.5), v=(0.2, 0.0, 0.0)), surface), PerchSettings(), load_vehicle("snapdragon"))
print(json.dumps([COMPILED, answer.trajectory.durations.tolist(), answer.trajectory.coefficients.tolist(),
                  [[c.minimum, c.maximum] for c in answer.certificates if c.quantity != "clearance"]]))
"""


def test_the_plan_is_the_same_without_numba():
    answers = []
    for switch in ("1", "0"):
        out = subprocess.run([sys.executable, "-c", _PLAN_BY_INTERPRETER], capture_output=True, text=True, check=True,
                             env={**os.environ, "PERCH_NUMBA": switch})
        answers.append(json.loads(out.stdout))
    compiled, interpreted = answers
    assert compiled[0] and not interpreted[0]
    for one, other in zip(compiled[1:], interpreted[1:]):
        assert np.array(one) == pytest.approx(np.array(other), abs=1e-8)
