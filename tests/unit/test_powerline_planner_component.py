"""Component `PowerlinePlannerComponent`: perches with recoveries, deadlines, and typed answers to nonsense, in process and isolated."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perch_core.job import Job, JobFailed, JobStopped
from perch_core.errors import ConfigError
from perch_core.isolated import IsolatedRunner
from perch_core.values import AtEnd, MappedPowerline, PowerlinePlan, PowerlinePlanRequest
from perch_core.vehicle import load_vehicle
from perch_planner import powerline_planner
from perch_planner.powerline import problem
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.service import PowerlinePlanError
from perch_planner.powerline.settings import Margins, PowerlineSettings
from perch_planner.powerline_planner import PowerlinePlannerComponent, PowerlinePlannerParameters
from unit.planner_asker import Asked

ROOT = Path(__file__).resolve().parents[2]
LINES = problem.load("powerline_line_80").segments()
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
DOWN = LINES[0].centre - [0.0, 0.0, 0.175]


def line(id: int, start: Any, end: Any, radius: float = 0.03) -> MappedPowerline:
    return MappedPowerline(id, tuple(map(float, start)), tuple(map(float, end)), radius, np.zeros((3, 3)), 0.0, 10)


KNOWN = tuple(line(10 + known.id, *known.ends, known.radius) for known in LINES)


def request(**changes: Any) -> PowerlinePlanRequest:
    """The 80 deg perch, changed."""
    fields: dict[str, Any] = dict(
        start=12_500_000_000, p=np.array([0.0, 0.0, 4.3]), q=LEVEL, lines=KNOWN, target_line=10, perch_point=LINES[0].centre,
        perch_pitch=math.radians(80.0), with_recovery=True)
    return PowerlinePlanRequest(**fields | changes)


def planner(parameters: PowerlinePlannerParameters, runner: IsolatedRunner | None = None) -> Asked:
    return Asked(PowerlinePlannerComponent(parameters), "plan_powerline", runner)


@pytest.fixture(scope="module")
def ask() -> Asked:
    return planner(PowerlinePlannerParameters())


@pytest.fixture(scope="module")
def isolated() -> Iterator[Asked]:
    parameters = PowerlinePlannerParameters(deadline=10.0)
    runner = IsolatedRunner(PowerlinePlannerComponent(parameters).preload())
    assert runner.wait_ready()
    yield planner(parameters, runner)
    runner.close()


def test_the_error_codes_are_those_of_the_service() -> None:
    from perch_msgs.srv import PlanPowerline

    assert all(getattr(PlanPowerline.Response, code.name) == code for code in PowerlinePlanError)
    answer = (ROOT / "src" / "perch_msgs" / "srv" / "PlanPowerline.srv").read_text().partition("---\n")[2]
    assert {name: int(code) for name, code in re.findall(r"^uint8 (\w+)=(\d+)", answer, re.MULTILINE)} == {code.name: code for code in PowerlinePlanError}


def test_a_perch_with_recovery_is_one_trajectory_with_certificates(ask: Asked) -> None:
    plan = ask(request())
    assert plan.success and plan.error_code == PowerlinePlanError.OK, plan.message
    t = plan.trajectory
    assert t.start_time == 12.5 and plan.at_end == AtEnd.RECOVER
    assert plan.perch_time == plan.recovery_start and t.duration == pytest.approx(plan.perch_time + plan.recovery_time)
    np.testing.assert_allclose(np.linalg.norm(t.q, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(t.v[-1], 0, atol=0.02)
    assert {c.quantity for c in plan.certificates} >= {"clearance", "height", "thrust", "thrust_rate", "body_rate",
                                                       "recovery_clearance", "recovery_height"}
    assert all(c.holds for c in plan.certificates)
    assert plan.solver == "fatrop" and plan.iterations > 0 and plan.solve_time > 0 and plan.recovery_solve_time > 0


def test_isolated_plans_are_those_of_this_process_to_the_last_bit(ask: Asked, isolated: Asked) -> None:
    here, there = ask(request()), isolated(request())
    assert here.message == there.message and here.certificates == there.certificates and here.iterations == there.iterations
    for name in ("times", "p", "q", "v", "w", "a", "dw", "rotor_thrust"):
        assert getattr(here.trajectory, name).tobytes() == getattr(there.trajectory, name).tobytes()


def test_a_full_pose_and_no_recovery(ask: Asked) -> None:
    p = LINES[1].centre - [0.0, 0.0, 0.15]
    plan = ask(request(perch_pose=(p, np.array([1.0, 0.0, 0.0, 0.0])), target_line=11, with_recovery=False))
    assert plan.success, plan.message
    assert plan.at_end == AtEnd.CONTACT and plan.recovery_start < 0 and plan.contact_time > 0
    np.testing.assert_allclose(plan.trajectory.p[-1], p, atol=1e-3)


def test_a_recovery_alone_starts_from_the_given_state(ask: Asked) -> None:
    tilted = np.array([0.0, -math.sin(math.radians(40)), 0.0, math.cos(math.radians(40))])
    plan = ask(request(p=np.array([3.0, 0.0, 4.3]), q=tilted, v=np.array([1.0, 0.0, 0.0]), recovery_only=True))
    assert plan.success, plan.message
    assert plan.at_end == AtEnd.HOLD and plan.recovery_start == 0.0 and plan.perch_time == 0.0
    t = plan.trajectory
    assert t.v[0, 0] == pytest.approx(1.0) and abs(t.v[-1, 0]) < 0.02 and t.q[-1, 3]**2 + t.q[-1, 2]**2 > 0.99999


E = PowerlinePlanError
B, NAN = E.BAD_INPUT, math.nan
CROSSING = (*KNOWN, line(20, (3.0, 0.0, 4.2), (6.0, 0.0, 4.2)))
VERTICAL = (line(10, (4.0, 0.0, 3.0), (4.0, 0.0, 6.0)),)
NONSENSE = [
    (dict(lines=()), E.EMPTY_MAP, "not in the map"), (dict(target_line=3), E.EMPTY_MAP, "target line 3"),
    (dict(target_line=-1), B, "target_line"), (dict(lines=CROSSING), B, "lines 10 and 20 cross"),
    (dict(lines=(KNOWN[0], KNOWN[0])), B, "same id"),
    (dict(lines=tuple(line(k, (k, 0, 1), (k, 1, 1)) for k in range(300))), B, "300 entries"),
    (dict(lines=(line(10, (4.0, 0.0, 4.0), (4.0, 0.0, 4.0)),)), B, "must be > 0"),
    (dict(lines=(line(10, (4.0, NAN, 4.0), (4.0, 1.0, 4.0)),)), B, r"lines.0.\.start: nan"),
    (dict(lines=(line(10, (4.0, 0.0, 4.0), (4.0, 1e308, 4.0)),)), B, r"lines.0.\.end: 1e.308"),
    (dict(lines=(line(10, (4.0, 0.0, 4.0), (4.0, 1.0, 4.0), 0.0),)), B, "radius: 0 is outside"),
    (dict(lines=VERTICAL), B, "vertical"), (dict(perch_pitch=4.0), B, "perch_pitch: 4 is outside"),
    (dict(perch_pitch=NAN), B, "perch_pitch: nan"),
    (dict(perch_point=np.array([NAN, 0.0, 0.0])), B, "perch_point: nan"),
    (dict(perch_point=np.array([1e308, 0.0, 0.0])), B, "perch_point: 1e.308"),
    (dict(perch_point=LINES[0].ends[1] + 8.0 * LINES[0].direction), B, "8.00 m from line 10"),
    (dict(end_velocity=np.array([1e9, 0.0, 0.0])), B, "end_velocity"), (dict(p=np.array([0.0, 0.0, math.inf])), B, "p: inf"),
    (dict(p=np.array([-1e9, 0.0, 4.3])), B, "p: -1e.09"), (dict(v=np.array([0.0, NAN, 0.0])), B, "v: nan"),
    (dict(w=np.full(3, 1e9)), B, "w: 1e.09"),
    (dict(q=0.5 * LEVEL), B, "norm 0.5"), (dict(q=np.zeros(4)), B, "norm 0.0"),
    (dict(p=np.array([0.0, 0.0, 0.5])), E.START_INVALID, "below height_min"),
    (dict(p=np.array([4.0, 0.0, 4.25])), E.START_INVALID, "nearer than the body"),
    (dict(q=np.array([0.0, 0.0, 1.0, 0.0])), B, "behind the vehicle"),
    (dict(v=np.array([50.0, 0.0, 0.0])), E.START_INVALID, "speed"),
    (dict(rotor_thrust=(1.0, 2.0)), B, "2 values"), (dict(rotor_thrust=(NAN,) * 4), B, "rotor_thrust: nan"),
    (dict(rotor_thrust=(900.0,) * 4), E.START_INVALID, "rotor thrusts"),
    (dict(perch_pose=(LINES[0].centre, LEVEL)), E.PERCH_IN_COLLISION, "cuts line 10"),
    (dict(perch_pose=(np.array([4.0, 0.0, 5.2]), LEVEL)), B, "gripper"),
    (dict(perch_pose=(np.full(3, NAN), LEVEL)), B, "perch_pose.position: nan"),
    (dict(perch_pose=(DOWN, np.zeros(4))), B, "norm"), (dict(start=-5), B, "start"),
    (dict(deadline=-1.0), B, "deadline: -1"), (dict(deadline=NAN), B, "deadline: nan"), (dict(deadline=math.inf), B, "deadline: inf"),
    (dict(deadline=1e-4), E.DEADLINE, "0.0001 s"),
    (dict(p=np.array([-9e3, 0.0, 4.3])), E.INFEASIBLE, r"9003\.\d m away"),
]


@pytest.mark.parametrize(("changes", "code", "words"), NONSENSE)
def test_nonsense_is_answered_with_a_typed_error_in_time(isolated: Asked, changes: dict, code: int, words: str) -> None:
    plan = isolated(request(**changes))
    assert all(job.limit is not None and job.limit < 15.0 for job in isolated.jobs)  # the runner ends them then
    assert (plan.success, plan.error_code, plan.trajectory) == (False, code, None), plan.message
    assert re.search(words, plan.message), plan.message


def test_after_all_that_it_plans(isolated: Asked) -> None:
    assert isolated(request()).success
    assert isolated.jobs and all(job.limit is not None and job.limit < 15.0 for job in isolated.jobs)


def test_deadlines_are_those_of_the_request_but_never_longer_than_ten_seconds() -> None:
    for asked, first in ((0.0, 6.0), (5.0, 3.0), (1e9, 6.0)):
        (job,), _ = stopped(PowerlinePlannerComponent(PowerlinePlannerParameters(deadline=10.0)), request(deadline=asked), JobFailed("not tried"))
        assert job.limit == job.arguments[0].request.deadline == pytest.approx(first)
    with pytest.raises(ConfigError, match="deadline"):
        replace_checked(deadline=11.0)


def replace_checked(**changes: Any) -> PowerlinePlannerParameters:
    from perch_core import config

    return config.replace(PowerlinePlannerParameters(), **changes)


def stopped(component: PowerlinePlannerComponent, asked: PowerlinePlanRequest, *endings: Any) -> tuple[list[Job], list[PowerlinePlan]]:
    """Jobs and answers where the jobs end as told."""
    jobs: list[Job] = []
    answers: list[PowerlinePlan] = []
    left = list(endings)

    def work(job: Job) -> None:
        jobs.append(job)
        ending = left.pop(0)
        job.then(job.function(*job.arguments) if ending is None else ending)

    component.work = work
    component.on_plan_powerline(asked, answers.append)
    return jobs, answers


def test_ipopt_gets_the_rest_of_the_deadline() -> None:
    component = PowerlinePlannerComponent(PowerlinePlannerParameters())
    jobs, (plan,) = stopped(component, request(deadline=5.0), JobStopped("stopped"), None)
    assert [job.limit for job in jobs] == pytest.approx([3.0, 2.0]) and all(job.isolated for job in jobs)
    assert plan.success and plan.solver == "ipopt"


@pytest.mark.parametrize(("endings", "code", "words"), [
    ([JobStopped("solve: stopped"), JobStopped("solve: stopped")], E.DEADLINE, "no plan within 5 s"),
    ([JobFailed("solve: its process crashed (SIGSEGV)")], E.SOLVER, "SIGSEGV"),
    ([JobStopped("solve: stopped"), JobFailed("solve: out of memory")], E.SOLVER, "out of memory"),
])
def test_jobs_that_end_without_a_plan_are_answered(endings: list, code: int, words: str) -> None:
    _, (plan,) = stopped(PowerlinePlannerComponent(PowerlinePlannerParameters()), request(deadline=5.0), *endings)
    assert plan.error_code == code and words in plan.message


def test_a_deadline_counts_while_others_are_planned_and_the_next_is_planned_all_the_same(isolated: Asked, tmp_path: Path) -> None:
    component = PowerlinePlannerComponent(PowerlinePlannerParameters())
    futures: list[Any] = []
    component.work = lambda job: futures.append((job, isolated.runner.submit(replace(job, limit=600.0) if len(futures) == 1 else job)))
    answers: list[PowerlinePlan] = []
    os.mkfifo(tmp_path / "pipe")
    other = isolated.runner.submit(Job(Path.read_bytes, (tmp_path / "pipe",), print, 600.0))  # until somebody writes
    component.on_plan_powerline(request(deadline=0.5), answers.append)
    component.on_plan_powerline(request(deadline=8.0), answers.append)
    assert isinstance(futures[0][1].exception(120.0), JobStopped)  # before its turn has come
    (tmp_path / "pipe").write_bytes(b"go on")
    for job, future in futures:  # grows by the fallback of the first
        job.then(future.exception(600.0) or future.result())
    assert other.result(120.0) == b"go on"
    next_one, first = answers  # IPOPT has what is left of the first one's deadline: it may do
    assert next_one.success and first.error_code in (E.OK, E.DEADLINE)
    assert len(futures) == 3


def test_the_planning_process_may_be_killed_in_the_middle(isolated: Asked, tmp_path: Path) -> None:
    component = PowerlinePlannerComponent(PowerlinePlannerParameters())
    futures: list[Any] = []
    hang = ["sh", "-c", f"touch {tmp_path / 'begun'}; exec sleep 60"]
    component.work = lambda job: futures.append((job, isolated.runner.submit(replace(job, function=subprocess.run, arguments=(hang,)))))
    answers: list[PowerlinePlan] = []
    component.on_plan_powerline(request(deadline=10.0), answers.append)
    (job, future), = futures
    while not (tmp_path / "begun").exists():
        time.sleep(0.01)
    os.kill(isolated.runner.pid, signal.SIGKILL)
    job.then(future.exception(120.0))
    assert answers[0].error_code == E.SOLVER and "ended" in answers[0].message
    assert isolated.runner.wait_ready() and isolated(request()).success


def test_what_nobody_had_foreseen_is_a_refusal(ask: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise IndexError("list index out of range")

    monkeypatch.setattr(powerline_planner.PowerlinePlanner, "plan", broken)
    plan = ask(request())
    assert plan.error_code == E.SOLVER and "IndexError: list index out of range" in plan.message


def test_a_planner_is_loaded_once_whatever_may_change(ask: Asked) -> None:
    powerline_planner.cached_planner.cache_clear()
    changed = PowerlinePlannerComponent(PowerlinePlannerParameters(deadline=3.0))
    ask.component.preload()()
    changed.preload()()
    assert powerline_planner.cached_planner.cache_info().misses == 1
    ask.component.reconfigure(PowerlinePlannerParameters(deadline=4.0))
    assert ask(request()).success and powerline_planner.cached_planner.cache_info().misses == 1


@pytest.mark.parametrize(("changes", "words"), [(dict(camera="rear"), "no camera"), (dict(vehicle="snapdragon"), "thrust_rate_max")])
def test_parameters_that_cannot_be_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        PowerlinePlannerComponent(PowerlinePlannerParameters(**changes))
    with pytest.raises(ConfigError, match=words):  # as scripts/plan.py asks
        PowerlinePlanner(load_vehicle(changes.get("vehicle", "rpg")), PowerlineSettings(camera=changes.get("camera", "front")))


@pytest.mark.parametrize(("margins", "words"), [(dict(thrust=4.5), "margins.thrust: .* nothing is left"), (dict(body_rate=4.0), "margins.body_rate: 4 rad/s")])
def test_margins_that_leave_nothing_of_a_vehicles_limits_are_refused(margins: dict, words: str) -> None:
    """With a body rate of 0 fatrop does not return; below 0 it would be a limit again."""
    settings = PowerlineSettings(margins=Margins(**margins))
    with pytest.raises(ConfigError, match=words):
        settings.check(replace(load_vehicle("rpg"), body_rate_max=4.0))
