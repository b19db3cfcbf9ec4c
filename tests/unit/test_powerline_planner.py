"""The planner around the solver: recoveries from anywhere, extra lines, files and reports."""

from __future__ import annotations

import csv
import json
import subprocess
from copy import copy
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from perch_control.mission.requests import plan_answer
from perch_control.mission.values import Refusal
from perch_core import config, so3
from perch_core.errors import ConfigError, PlanningRefusal
from perch_core.lines import Segment, scaled_clearance
from perch_core.rotor_model import P, Q, V
from perch_core.values import AtEnd
from perch_core.vehicle import load_vehicle
from perch_planner.powerline import problem, relaxation, search, service
from perch_planner.powerline.plan import Manoeuvre, PowerlinePlan
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.problem import PlannedProblem
from perch_planner.powerline.report import write_report
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings
from system.scripts import call_script

ROOT = Path(__file__).resolve().parents[2]
VEHICLE = load_vehicle("rpg")
SETUP = problem.load("powerline_line_80")
REQUEST = replace(SETUP.request(VEHICLE), deadline=60.0)  # a busy machine plans, too


@pytest.fixture(scope="module")
def planner() -> PowerlinePlanner:
    return PowerlinePlanner(VEHICLE)


def with_settings(planner: PowerlinePlanner, settings: PowerlineSettings) -> PowerlinePlanner:
    """Another planner with the same solvers, which depend on no setting but the camera."""
    assert settings.camera == planner.settings.camera
    other = copy(planner)
    other.settings = settings
    return other


@pytest.fixture(scope="module")
def planned(planner: PowerlinePlanner) -> PlannedProblem:
    return PlannedProblem(SETUP, VEHICLE, REQUEST, planner, planner.plan(REQUEST))


@pytest.mark.parametrize("why, target, pitch_deg, along, position, yaw, velocity, perception", [
    ("between two nodes the body cuts a wire that it passes", 2, 138.1, -0.27, (2.28, 1.48, 5.57), -0.2, (-0.04, 0.03, 0.15), True),
    ("the perch pose is nearer to another wire than the margin", 2, 150.76, -0.17, (1.57, -1.11, 5.38), 0.56, (0.46, 0.34, 0.01), False),
    ("with 30 intervals the end is missed by millimetres", 0, 172.47, 0.18, (0.89, 0.47, 2.29), 0.7, (0.35, 0.46, -0.06), True)])
def test_a_plan_is_found_where(planner: PowerlinePlanner, why: str, target: int, pitch_deg: float, along: float,
                               position: tuple, yaw: float, velocity: tuple, perception: bool) -> None:
    """And it keeps all its bounds when it is integrated again. [tests P:eq14]"""
    start = REQUEST.start.copy()
    start[P], start[Q], start[V] = position, so3.quat_exp(np.array([0.0, 0.0, yaw])), velocity
    line = SETUP.segments()[target]
    perch = PerchPose.on_line(line, line.centre + along * line.direction, np.radians(pitch_deg), VEHICLE.wire_offset, start[P])
    plan = planner.plan(replace(REQUEST, start=start, target_line=target, perch=perch, perception=perception))
    assert plan.recovery is not None and all(bound.holds for bound in plan.bounds), why


@pytest.mark.parametrize("why, line_height, pitch_deg, position, perception", [
    ("the start is nearer to the least height than the margin", 2.0, 134.0, (1.0, 0.5, 0.81), True),
    ("the perch is nearer to the least height than the margin", 0.68, 24.0, (1.5, 0.3, 1.2), True)])
def test_a_plan_is_found_near_the_limits(planner: PowerlinePlanner, why: str, line_height: float, pitch_deg: float, position: tuple,
                                         perception: bool) -> None:
    line = Segment(np.array([4.0, 0.0, line_height]), np.array([0.0, 1.0, 0.0]), 3.0, 0.03, 0)
    start = REQUEST.start.copy()
    start[P] = position
    perch = PerchPose.on_line(line, line.centre, np.radians(pitch_deg), VEHICLE.wire_offset, start[P])
    plan = planner.plan(replace(REQUEST, start=start, lines=(line,), target_line=0, perch=perch, perception=perception, with_recovery=False))
    assert all(bound.holds for bound in plan.bounds), why


@pytest.mark.parametrize("what, pitch_deg, along, position, yaw, velocity", [
    ("perch", 154.67, -0.039, (1.97, 1.126, 5.259), -0.143, (0.03, -0.093, -0.124)),
    ("recovery", 120.42, -0.082, (1.279, -1.429, 5.275), 0.624, (0.428, 0.118, -0.305))])
def test_clearance_in_the_open_is_eased_where_no_plan_has_what_is_shipped(planner: PowerlinePlanner, what: str, pitch_deg: float, along: float,
                                                                          position: tuple, yaw: float, velocity: tuple) -> None:
    start = REQUEST.start.copy()
    start[P], start[Q], start[V] = position, so3.quat_exp(np.array([0.0, 0.0, yaw])), velocity
    line = SETUP.segments()[2]
    perch = PerchPose.on_line(line, line.centre + along * line.direction, np.radians(pitch_deg), VEHICLE.wire_offset, start[P])
    request = replace(REQUEST, start=start, target_line=2, perch=perch, perception=False)
    plan = with_settings(planner, SETUP.settings).plan(request)
    assert plan.recovery is not None and all(bound.holds for bound in plan.bounds), what


@pytest.mark.parametrize("share", [0.0, 0.4, 0.8, 1.0])
def test_an_abort_at_any_time_finds_a_recovery(planner: PowerlinePlanner, planned: PlannedProblem, share: float) -> None:
    perch = planned.plan.perch
    state = perch.states[int(share * (len(perch.times) - 1))]
    plan = planner.plan(replace(REQUEST, start=state, perch=None, recovery_only=True))
    assert plan.perch is None and all(bound.holds for bound in plan.bounds)
    np.testing.assert_allclose(plan.recovery.states[0, :13], state[:13])
    assert np.linalg.norm(plan.recovery.states[-1, V]) < 0.02
    assert so3.quat_to_matrix(plan.recovery.states[-1, Q])[2, 2] > np.cos(np.radians(0.1))


def test_a_recovery_is_found_from_each_instant_of_the_way_to_an_upside_down_perch(planner: PowerlinePlanner) -> None:
    """About 0.35 s before the contact the vehicle rises at 3.7 m/s, tipped by 90 degrees, with its rotors idle."""
    request = problem.load("powerline_line_180").request(VEHICLE)
    perch = planner.plan(request).perch
    for before in (0.37, 0.36, 0.35, 0.34):
        state = perch.states[np.searchsorted(perch.times, perch.duration - before)]
        plan = planner.plan(replace(request, start=state, hover=request.start[P], perch=None, recovery_only=True))
        assert all(bound.holds for bound in plan.bounds)


@pytest.mark.parametrize("radius, air", [(0.03, 0.002), (0.03, -0.005), (0.015, -0.005)])
def test_a_recovery_begins_even_where_the_flight_has_eaten_the_margin(planner: PowerlinePlanner, planned: PlannedProblem, radius: float,
                                                                      air: float) -> None:
    state, lines = planned.plan.perch.states[-1].copy(), tuple(replace(line, radius=radius) for line in REQUEST.lines)
    state[P] -= (0.06 - radius - air) * REQUEST.perch.s3_W
    plan = planner.plan(replace(REQUEST, lines=lines, start=state, perch=None, recovery_only=True))
    assert all(bound.holds for bound in plan.bounds)


def test_a_perch_after_which_no_recovery_is_found_is_given_without_one(planner: PowerlinePlanner) -> None:
    """With the reason; the mission, which asks for recoveries, takes it for a refusal."""
    plan = with_settings(planner, config.replace(SETUP.settings, recovery_duration=(0.01, 0.02))).plan(REQUEST)
    assert plan.recovery is None and "no recovery" in plan.without_recovery and all(bound.holds for bound in plan.bounds)
    answer = service.plan_response(plan, planner.solver.model, 0)
    assert answer.success and answer.at_end == AtEnd.CONTACT and answer.recovery_start < 0.0
    assert "without recovery: no recovery" in answer.message
    assert plan_answer(answer) == Refusal(answer.message)


@pytest.mark.parametrize("duration", [16.5, 18.0, 30.0])
def test_the_longest_plan_has_no_more_points_than_the_controller_takes(planner: PowerlinePlanner, duration: float) -> None:
    n = round(1e3 * duration)
    part = Manoeuvre(np.linspace(0.0, duration, n + 1), np.tile(REQUEST.start, (n + 1, 1)), np.zeros((n + 1, 4)), (), 30, "", 0, 0.0, 0.0, 0.0)
    answer = service.plan_response(PowerlinePlan(part, part), planner.solver.model, 0)
    assert not isinstance(plan_answer(answer), Refusal) and answer.trajectory.duration == pytest.approx(2.0 * duration)


def test_a_recovery_keeps_away_from_the_wire_that_it_left(planner: PowerlinePlanner, planned: PlannedProblem) -> None:
    """A vehicle that missed the wire is centimetres from where the plan has it."""
    recovery, vehicle = planned.plan.recovery, planner.vehicle
    later = recovery.states[recovery.times > 0.3 * recovery.duration]
    nearest = min(float(scaled_clearance(later[:, P], later[:, Q], line, vehicle.body_radii).min()) for line in planned.request.lines)
    assert (1 + nearest) ** 2 > (1 + planner.settings.margins.leaving) / (1 - planner.settings.margins.leaving) - 0.02


def test_the_wire_is_met_from_above_the_gripper_with_room_beside_the_rotors_until_shortly_before(planner: PowerlinePlanner) -> None:
    """A map that is centimetres off must not bring the rotors to the wire before the gripper."""
    perch = planner.plan(replace(REQUEST, with_recovery=False)).perch
    open_air = perch.states[(perch.times < 0.87 * perch.duration)]
    nearest = float(scaled_clearance(open_air[:, P], open_air[:, Q], REQUEST.target(), VEHICLE.body_radii).min())
    assert (1 + nearest) ** 2 > 1.4 / 0.6 - 0.05
    assert all(bound.holds for bound in perch.bounds)


def test_a_recovery_above_a_mast_is_found(planner: PowerlinePlanner) -> None:
    mast = Segment([2.5, 0.0, 1.0], [0.0, 0.0, 1.0], 1.0, 0.05)
    start = REQUEST.start.copy()
    start[P] = 2.5, 0.0, 4.2
    recovery = planner.plan(replace(REQUEST, start=start, lines=(mast,), perch=None, recovery_only=True)).recovery
    assert recovery.duration < 1.0 and all(bound.holds for bound in recovery.bounds)


def test_a_recovery_from_inside_a_wire_is_refused(planner: PowerlinePlanner, planned: PlannedProblem) -> None:
    state = planned.plan.perch.states[-1].copy()
    state[P] -= 0.1 * REQUEST.perch.s3_W
    with pytest.raises(PlanningRefusal, match=r"the body cuts a line, even with its radius reduced by 0\.02 m: scaled distance 0\.\d\d < 1") as refusal:
        planner.plan(replace(REQUEST, start=state, perch=None, recovery_only=True))
    assert refusal.value.code == "start_invalid"


def test_more_lines_than_the_problem_holds_are_all_avoided(planner: PowerlinePlanner) -> None:
    fence = tuple(Segment([8.0 + 0.3 * k, 0, 4.2], [0, 1, 0], 2.0, 0.03, 100 + k) for k in range(2 * search.LINES_MAX))
    plan = planner.plan(replace(REQUEST, lines=REQUEST.lines + fence, with_recovery=False))
    assert next(b for b in plan.bounds if b.quantity == "clearance").holds


def test_the_end_velocity_is_free_to_choose(planner: PowerlinePlanner) -> None:
    wanted = np.array([0.2, 0.1, -0.3])
    plan = planner.plan(replace(REQUEST, perch=replace(REQUEST.perch, v_W=wanted)))
    np.testing.assert_allclose(plan.perch.states[-1, V], wanted, atol=0.02)
    assert all(bound.holds for bound in plan.bounds)


@pytest.mark.parametrize("point", [[4.0, 0.0, 4.2], [4.0, 2.0, 4.2]])
def test_a_sagging_cable_of_segments_is_gripped_in_the_middle_and_at_a_joint(planner: PowerlinePlanner, point: list[float]) -> None:
    y = np.linspace(-10, 10, 6)
    knots = np.stack([np.full(6, 4.0), y, 4.2 + 0.5 * (y / 10) ** 2 - 0.02], axis=1)
    cable = tuple(Segment.between(a, b, 0.02, i) for i, (a, b) in enumerate(zip(knots, knots[1:])))
    pose = PerchPose.on_line(cable[2], np.array(point), np.radians(120), VEHICLE.perch_offset, REQUEST.start[P])
    plan = planner.plan(replace(REQUEST, lines=cable, target_line=2, perch=pose))
    assert all(bound.holds for bound in plan.bounds)


def test_a_perch_that_no_trajectory_reaches_is_refused_with_what_is_violated(planner: PowerlinePlanner) -> None:
    # Gaps of 0.2 m: even edge on the body needs 0.24 m. (It does slip through gaps of 0.35 m.)
    cage = tuple(Segment([2.0, 0.0, 0.5 + 0.2 * k], [0, 1, 0], 60.0, 0.03, 100 + k) for k in range(120))
    with pytest.raises(PlanningRefusal, match="no perch within the limits: clearance") as refusal:
        planner.plan(replace(REQUEST, lines=REQUEST.lines + cage, with_recovery=False))
    assert refusal.value.code == "infeasible" and refusal.value.margin < 0.0


def near_the_ground(drop: float = 2.6) -> PowerlineRequest:
    """Upside down under wires that hang lower than in the 80 deg problem [m]: the dive for it needs height."""
    lines = tuple(Segment(line.centre - [0.0, 0.0, drop], line.direction, line.half_length, line.radius, line.id) for line in REQUEST.lines)
    start = REQUEST.start.copy()
    start[2] -= drop
    perch = PerchPose.on_line(lines[0], lines[0].centre, np.pi, VEHICLE.wire_offset, start[P])
    return replace(REQUEST, start=start, lines=lines, perch=perch, with_recovery=False)


def test_a_perch_that_is_not_found_is_refused_with_the_limit_without_which_it_is(planner: PowerlinePlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relaxation, "IPOPT_TIME_FACTOR", np.inf)  # IPOPT takes seconds to find none either
    with pytest.raises(PlanningRefusal, match=r"keeps the height limit; without it there is one: height in .* required \[0.8") as refusal:
        planner.plan(near_the_ground())
    assert (refusal.value.code, refusal.value.constraint) == ("infeasible", "height [P:eq14e]") and refusal.value.margin < 0.0
    lower = with_settings(planner, config.replace(planner.settings, height_min=0.2)).plan(near_the_ground())
    assert 0.2 <= lower.perch.states[:, 2].min() < 0.8


def test_a_refusal_says_that_no_limit_alone_is_the_cause(planner: PowerlinePlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relaxation, "RELAXATIONS", relaxation.RELAXATIONS[3:])
    monkeypatch.setattr(search, "ATTEMPTS", 3)
    with pytest.raises(PlanningRefusal, match="no single limit was identified as the cause .*: thrust range of the rotors, body-rate limit") as refusal:
        planner.plan(near_the_ground())
    assert refusal.value.code == "infeasible"


def test_no_cause_is_looked_for_after_the_deadline(planner: PowerlinePlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    solve, phases = planner.solver.solve, []
    monkeypatch.setattr(planner.solver, "solve", lambda structure, data, phase: phases.append(phase) or solve(structure, data, phase))
    with pytest.raises(PlanningRefusal, match="no time was left to search for the cause"):
        planner.plan(replace(near_the_ground(), deadline=1e-3))
    assert phases == ["gauss_newton"]


def test_each_search_for_the_cause_gets_the_time_that_is_left(planner: PowerlinePlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, deadlines = count(), []

    def refuse(_: search.Search, task: search.Task, *args: object, **kwargs: object) -> None:
        deadlines.append(task.request.deadline)
        raise search.NotConverged(task.name, "", 0.1)

    monkeypatch.setattr(relaxation, "perf_counter", lambda: float(next(clock)))
    monkeypatch.setattr(search.Search, "solve_and_check", refuse)
    with pytest.raises(PlanningRefusal, match="no single limit"):
        relaxation.plan_perch(search.Search(VEHICLE, planner.settings, planner.formulation, planner.solver), replace(REQUEST, deadline=60.0),
                              REQUEST.perch, 60.0)
    assert deadlines == [60.0, 60.0, 59.0, 58.0, 57.0, 56.0, 55.0]


def test_a_perch_found_without_a_limit_that_it_keeps_is_a_plan(planner: PowerlinePlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    solve = planner.solver.solve
    monkeypatch.setattr(planner.solver, "solve", lambda structure, data, phase: replace(solve(structure, data, phase), converged=phase == "trial"))
    perch = planner.plan(replace(REQUEST, with_recovery=False)).perch
    assert all(bound.holds for bound in perch.bounds)
    assert next(bound for bound in perch.bounds if bound.quantity == "height").lower_limit == planner.settings.height_min


def test_the_report_holds_what_was_planned(planned: PlannedProblem, tmp_path: Path) -> None:
    written = write_report(planned, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan.csv", "plan.json", "plan.png", "visibility.png"]
    content = json.loads((tmp_path / "plan.json").read_text())
    assert content["perch"]["duration_s"] == planned.plan.perch.duration == written["perch"]["duration_s"]
    assert all(certificate["holds"] for certificate in content["certificates"])
    with (tmp_path / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    joint = min(rows, key=lambda row: abs(float(row["t"]) - planned.plan.perch.duration))
    np.testing.assert_allclose([float(joint[f"p_{axis}"]) for axis in "xyz"], REQUEST.perch.p_WB, atol=1e-3)
    assert float(rows[-1]["t"]) == pytest.approx(planned.plan.perch.duration + planned.plan.recovery.duration)


def test_plan_script_plans_and_refuses(tmp_path: Path) -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess:
        return call_script("plan.py", *arguments, "--out", str(tmp_path))

    done = run("powerline_line_20")
    assert done.returncode == 0 and "perch of 2." in done.stdout and (tmp_path / "plan.png").is_file(), done.stderr
    refused = run("powerline_line_20", "--set", "height_min=4.5")
    assert refused.returncode == 1 and "below height_min 4.5 m" in refused.stderr
    assert run("powerline_line_20", "--set", "heigth_min=4.5").returncode == 2


@pytest.mark.parametrize(("change", "words"), [
    ("perch: {point: [4, 0, 4.2]}", "position and orientation, or point and pitch_deg"),
    ("perch: {point: [4, 0, 4.2], pitch_deg: 200}", "outside"),
    ("vehicle: [1]", "str"),
    ("lines: [{centre: [0, 0, 1], direction: [0, 1, 0], half_length: -1}]", "half_length"),
    ("settings: {duration: [3, 1]}", "interval"),
    ("gripper: 3", "unknown key"),
])
def test_problem_files_are_read_strictly(change: str, words: str, tmp_path: Path) -> None:
    key = change.partition(":")[0]
    text = (ROOT / "config" / "problems" / "powerline_line_80.yaml").read_text()
    kept, skip = [], False
    for line in text.splitlines():
        if not line.startswith((" ", "#")):
            skip = line.startswith(f"{key}:")
        if not skip:
            kept.append(line)
    path = tmp_path / "problem.yaml"
    path.write_text("\n".join([*kept, change]))
    with pytest.raises(ConfigError, match=words):
        problem.load(path)
