"""Component `PerchingPlanner`: proved plans, a plan from a running one, and typed answers to nonsense, in process and isolated."""

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
from perch_core import jit, so3
from perch_core.errors import ConfigError
from perch_core.isolated import IsolatedRunner
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import PerchPlan, PerchPlanRequest, nanoseconds, seconds
from perch_core.vehicle import load_vehicle
from perch_planner import perching_planner
from perch_planner.perching_planner import PerchingPlanner, PerchingPlannerParameters, PerchPlanError
from perch_planner.planner import plan
from perch_planner.problem import PerchSettings, StartState
from perch_planner.verifier import Requirements, verify
from unit.planner_asker import Asked

ROOT = Path(__file__).resolve().parents[2]
WALL = PerchSurface.from_inclination(np.array([1.7, 0.0, 1.4]), math.radians(90.0))


def request(surface: PerchSurface = WALL, **changes: Any) -> PerchPlanRequest:
    """A request with every option left to the planner's parameters."""
    fields: dict[str, Any] = {"start": 12_500_000_000, "p": np.array([0.0, 0.0, 1.4]), "p_WS": surface.p_WS,
                              "q_WS": so3.quat_from_matrix(surface.R_WS)}
    return PerchPlanRequest(**fields | changes)


def planner(parameters: PerchingPlannerParameters, runner: IsolatedRunner | None = None) -> Asked:
    return Asked(PerchingPlanner(parameters), "plan_perch", runner)


@pytest.fixture(scope="module")
def ask() -> Asked:
    return planner(PerchingPlannerParameters())


@pytest.fixture(scope="module")
def isolated() -> Iterator[Asked]:
    parameters = PerchingPlannerParameters(time_limit=45.0)  # a busy machine is no fault of the planner
    runner = IsolatedRunner(PerchingPlanner(parameters).preload())
    assert runner.wait_ready()
    yield planner(parameters, runner)
    runner.close()


def test_the_error_codes_are_those_of_the_service() -> None:
    from perch_msgs.srv import PlanPerch

    assert all(getattr(PlanPerch.Response, code.name) == code for code in PerchPlanError)
    answer = (ROOT / "src" / "perch_msgs" / "srv" / "PlanPerch.srv").read_text().partition("---\n")[2]
    assert {name: int(code) for name, code in re.findall(r"^uint8 (\w+)=(\d+)", answer, re.MULTILINE)} == {code.name: code for code in PerchPlanError}


def test_a_plan_comes_as_polynomials_with_certificates(ask: Asked) -> None:
    plan = ask(request())
    assert plan.success and plan.error_code == PerchPlanError.OK
    assert plan.trajectory.start_time == 12.5 and plan.contact_time > 0.0
    assert all(c.holds for c in plan.certificates) and plan.iterations >= 1
    limits = {c.quantity: (c.lower_limit, c.upper_limit) for c in plan.certificates}
    rest = np.zeros(3)
    need = Requirements(
        start=np.array([[0.0, 0.0, 1.4], rest, rest, rest]), start_yaw=(0.0, 0.0), end_yaw=0.0, waypoints=np.zeros((0, 4, 3)), p_S=WALL.p_WS,
        s1=WALL.R_WS[:, 0], s2=WALL.R_WS[:, 1], s3=WALL.normal, v_S=rest, perch_offset=0.04, mass=0.25,
        impact_acceleration=3.3, impact_speed=(0.65, 0.8), tangential_speed=0.3, contact_delay=0.04, tube=(0.12, 0.01, 0.1, 0.33),
        thrust=limits["thrust"], body_rate=limits["body_rate"][1], speed=limits["speed"][1], height=limits["height"],
        extension=0.15, duration=20.0)
    assert verify(plan.trajectory.durations, plan.trajectory.coefficients, need, step=1e-3) == []
    assert "clearance" in str(verify(plan.trajectory.durations, plan.trajectory.coefficients, replace(need, clearance=0.1), step=1e-3))


def test_options_of_a_request_replace_the_parameters(ask: Asked) -> None:
    free, bounded = ask(request()), ask(request(thrust_max=3.8, objective=3))
    thrust = {c.quantity: c for c in bounded.certificates}["thrust"]
    assert bounded.success and thrust.upper_limit == 3.8 and thrust.maximum <= 3.8
    assert {c.quantity: c for c in free.certificates}["thrust"].upper_limit > 3.8
    assert ask(request(minimum_time=True)).trajectory.duration < free.trajectory.duration


@pytest.mark.parametrize("inclination, height", [(60.0, 1.2), (90.0, 1.4), (180.0, 3.6)])
def test_speed_and_slip_are_bounded_for_contacts_on_time_and_late(ask: Asked, inclination: float, height: float) -> None:
    """Where no speed is within the window at both times, that of the planned contact is, as near to the other as it can be."""
    pad = PerchSurface.from_inclination(np.array([1.7, 0.0, height]), math.radians(inclination))
    end = ask(request(pad)).trajectory
    x = end.sample(end.duration)
    v = np.array([x.v, x.v + 0.03 * x.a])
    speeds = -v @ pad.normal
    assert np.linalg.norm(v @ pad.R_WS[:, :2], axis=1).max() <= 0.3
    if inclination < 100.0:
        assert 0.65 <= speeds.min() and speeds.max() <= 0.8
    else:
        assert 0.8 - 1e-6 <= speeds[0] <= 0.8 and speeds[1] == pytest.approx(0.8 - 0.03 * (3.3 + 9.81), abs=1e-6)


def test_rotors_that_give_less_are_planned_for(ask: Asked) -> None:
    whole, weaker = ({c.quantity: c for c in ask(request(thrust_ratio=ratio)).certificates} for ratio in (0.0, 0.83))
    for quantity in ("thrust", "rotor_thrust"):
        assert weaker[quantity].upper_limit == pytest.approx(0.83 * whole[quantity].upper_limit) and weaker[quantity].holds
    assert weaker["rotor_thrust"].maximum <= weaker["rotor_thrust"].upper_limit < whole["rotor_thrust"].maximum


@pytest.mark.parametrize("inclination", [0.0, 15.0, 30.0, 45.0, 60.0, 90.0])
def test_a_surface_that_faces_up_is_met_from_above(ask: Asked, inclination: float) -> None:
    """The plate does not pass through the surface on its way to it."""
    pad = PerchSurface.from_inclination(np.array([2.2, 0.0, 0.6]), math.radians(inclination))
    plan = ask(request(pad))
    assert plan.success, plan.message
    t = np.linspace(0.0, plan.trajectory.duration, 2000)
    samples = [plan.trajectory.sample(x) for x in t]
    assert min((x.p - pad.p_WS) @ pad.normal for x in samples) > 0.04 - 1e-6


def test_a_request_is_planned_as_by_plan_py_with_the_same_settings(ask: Asked) -> None:
    """The impact acceleration that a surface which faces up takes is part of the plan, not of the service; a requested one is kept."""
    pad = PerchSurface.from_inclination(np.array([2.2, 0.0, 0.6]), math.radians(20.0))
    direct = plan(perching_planner.perch_problem(request(pad)), PerchSettings(), load_vehicle("snapdragon"))
    assert np.array_equal(ask(request(pad)).trajectory.coefficients, direct.trajectory.coefficients)
    end = ask(request(pad, impact_acceleration=5.0)).trajectory
    assert np.linalg.norm(end.sample(end.duration).a + [0.0, 0.0, 9.81]) == pytest.approx(5.0)


def test_waypoints_motion_and_a_moving_target_are_taken(ask: Asked) -> None:
    plan = ask(request(v=np.array([0.5, 0.1, 0.0]), yaw=0.3, waypoints=np.array([[0.6, 0.1, 1.3]]),
                       target_velocity=np.array([0.3, 0.0, 0.0])))
    flown = plan.trajectory
    first, end = flown.sample(0.0), flown.sample(flown.duration)
    assert first.v == pytest.approx([0.5, 0.1, 0.0]) and first.yaw == pytest.approx(0.3)
    assert flown.sample(float(flown.durations[0])).p == pytest.approx([0.6, 0.1, 1.3], abs=1e-9)
    assert end.p == pytest.approx(WALL.p_WS + [0.3 * flown.duration - 0.04, 0.0, 0.0], abs=1e-9)


def test_a_running_trajectory_is_replaced_from_a_future_point(ask: Asked) -> None:
    first = ask(request()).trajectory
    moved = PerchSurface.from_inclination(np.array([1.75, 0.05, 1.4]), math.radians(85.0))
    second = ask(request(moved, start=13_200_000_000, current=first))
    assert second.success, second.message
    before, after = first.sample(0.7), second.trajectory.sample(0.0)
    for name in ("p", "v", "a", "j"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-6)
    late = ask(request(start=99_000_000_000, current=first))
    assert late.error_code == PerchPlanError.BAD_INPUT and "outside" in late.message


def test_a_trajectory_is_replaced_from_its_very_start_also_by_the_clock_of_today(ask: Asked) -> None:
    """A stamp in seconds has steps of 0.24 us then, and that of an answer is rounded twice."""
    stamp = next(s for s in range(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, 1_234_567) if seconds(s) < seconds(nanoseconds(seconds(s))))
    first = ask(request(start=stamp)).trajectory
    received = replace(first, start_time=seconds(nanoseconds(first.start_time)))
    assert ask(request(start=stamp, current=received)).success


def test_isolated_plans_are_those_of_this_process_to_the_last_bit(ask: Asked, isolated: Asked) -> None:
    for asked in (request(), request(waypoints=np.array([[0.6, 0.1, 1.3]])), request(impact_acceleration=40.0)):
        here, there = ask(asked), isolated(asked)
        for name in ("success", "error_code", "message", "iterations"):
            assert getattr(here, name) == getattr(there, name)
        assert here.certificates == there.certificates
        if here.success:
            assert here.trajectory.coefficients.tobytes() == there.trajectory.coefficients.tobytes()
            assert here.trajectory.durations.tobytes() == there.trajectory.durations.tobytes()
            assert here.trajectory.start_time == there.trajectory.start_time


B, X = PerchPlanError.BAD_INPUT, PerchPlanError.BOX
NAN, WILD = float("nan"), np.array([1e308, 0.0, 0.0])
REST, LEVEL = np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
SAMPLED = SampledTrajectory(np.array([0.0, 1.0]), REST, LEVEL, REST, REST, REST, REST, np.ones((2, 4)), 12.0)
NONSENSE = [
    ({"p": np.array([NAN, 0.0, 1.0])}, B, "p: nan is not finite"), ({"p": np.array([-1e9, 0.0, 1.0])}, B, "p: -1e.09 is outside"),
    ({"p": np.zeros(2)}, B, "shape"), ({"v": WILD}, B, "v: 1e.308 is outside .-100, 100. m/s"), ({"j": WILD}, B, "j: "),
    ({"a": np.array([0.0, np.inf, 0.0])}, B, "a: inf is not finite"), ({"yaw": NAN}, B, "yaw: nan"), ({"yaw_rate": 1e4}, B, "yaw_rate"),
    ({"p_WS": np.array([1e20, 0.0, 1.0])}, B, "p_WS: 1e.20 is outside"), ({"target_velocity": WILD}, B, "target_velocity: 1e.308"),
    ({"q_WS": np.zeros(4)}, B, "q_WS.*norm 0.0000"), ({"q_WS": np.array([0.0, 0.0, 0.0, NAN])}, B, "q_WS: norm nan"),
    ({"q_WS": np.array([0.0, 0.0, 0.0, 2.0])}, B, "q_WS"),
    ({"waypoints": np.ones((1000, 3))}, B, "waypoints: 1000 entries are more than 50"),
    ({"waypoints": np.array([[1.0, NAN, 1.0]])}, B, "waypoints: nan"), ({"segment_times": (1.0, 2.0)}, B, "segment_times"),
    ({"segment_times": (999.0,)}, B, "segment_times: 999 is outside"), ({"segment_times": (NAN,)}, B, "segment_times: nan"),
    ({"p": np.array([-1000.0, 0.0, 1.4])}, X, "1001.7 m, longer than speed_max 12 m/s covers in duration_max 20 s"),
    ({"impact_acceleration": -1.0}, B, "impact_acceleration"), ({"impact_acceleration": math.inf}, B, "impact_acceleration"),
    ({"impact_speed_min": 2.0}, B, "impact_speed"), ({"thrust_max": 1e308}, B, "thrust_max"), ({"thrust_min": 900.0}, B, "empty"),
    ({"thrust_ratio": 0.2}, B, "cannot lift"), ({"thrust_ratio": -1.0}, B, "thrust_ratio"), ({"thrust_ratio": NAN}, B, "thrust_ratio"),
    ({"objective": 2}, B, "objective"), ({"objective": 9}, B, "objective"), ({"start": -1}, B, "start"), ({"start": 10**30}, B, "start"),
    ({"current": FlatTrajectory(np.array([2.0]), np.full((1, 4, 100), 1.0), 12.0)}, B, "degree: 99"),
    ({"current": FlatTrajectory(np.full(200, 0.1), np.ones((200, 4, 6)), 12.0)}, B, "200 entries"),
    ({"current": FlatTrajectory(np.array([2.0]), np.full((1, 4, 6), 1e200), 12.0)}, B, "1e.200"),
    ({"current": SAMPLED}, B, "samples"),
    ({"impact_acceleration": 40.0}, PerchPlanError.UNREACHABLE_TILT, "m alpha"),
    ({"thrust_max": 2.3}, PerchPlanError.THRUST_FLOOR, "hover"),
    ({"p": np.array([3.0, 0.0, 1.4])}, X, "1.300 m behind the surface"), ({"v": np.array([50.0, 0.0, 0.0])}, X, "speed"),
    ({"a": np.array([500.0, 0.0, 0.0])}, B, "thrust|requires"), ({"j": np.array([1e5, 0.0, 0.0])}, PerchPlanError.BODY_RATE, "body rate of the start state"),
    ({"yaw_rate": 30.0}, PerchPlanError.BODY_RATE, "body rate of the start state is 30.0 rad/s"),
]


@pytest.mark.parametrize(("changes", "code", "words"), NONSENSE)
def test_nonsense_is_answered_with_a_typed_error_in_time_and_the_next_request_is_planned(isolated: Asked, changes: dict, code: int,
                                                                                         words: str) -> None:
    plan = isolated(request(**changes))
    assert (plan.success, plan.error_code, plan.trajectory) == (False, code, None), plan.message
    assert re.search(words, plan.message), plan.message
    assert isolated.lines[-1] == f"no plan: {plan.message}"
    assert isolated(request()).success
    longest = isolated.component.config.time_limit  # the runner ends them then
    assert isolated.jobs and all(job.limit is not None and job.limit <= longest for job in isolated.jobs)


def test_a_waypoint_that_is_given_fifty_times_is_flown_through(ask: Asked) -> None:
    plan = ask(request(waypoints=np.full((50, 3), [0.5, 0.0, 1.4])))
    assert plan.success, plan.message
    assert plan.trajectory.sample(float(plan.trajectory.durations[:50].sum())).p == pytest.approx([0.5, 0.0, 1.4], abs=1e-6)


def test_many_waypoints_do_not_outlast_the_longest_plan(ask: Asked) -> None:
    waypoints = np.array([[-4.0 * (k % 2), 1.5 * (k % 3), 1.4] for k in range(50)])
    plan = ask(request(waypoints=waypoints))
    assert plan.error_code == X and "no plan keeps the duration_max" in plan.message and "up to 20.00 s" in plan.message
    enough = planner(PerchingPlannerParameters(duration_max=0.8))(request())
    assert enough.error_code == X and "no plan keeps the duration_max" in enough.message


def test_a_guess_that_is_longer_than_the_longest_plan_is_shortened(ask: Asked) -> None:
    plan = ask(request(segment_times=(300.0,)))
    assert plan.success and plan.trajectory.duration <= 20.0, plan.message


def test_a_plan_that_takes_too_long_is_stopped(isolated: Asked) -> None:
    slow = planner(replace(isolated.component.config, time_limit=1e-4), isolated.runner)
    plan = slow(request())
    assert plan.error_code == PerchPlanError.TIME_LIMIT and "time_limit 0.0001 s" in plan.message
    assert isolated(request()).success


def test_the_planning_process_may_be_killed_in_the_middle(isolated: Asked, tmp_path: Path) -> None:
    waits = planner(isolated.component.config, isolated.runner)
    answers: list[PerchPlan] = []
    futures = []
    hang = ["sh", "-c", f"touch {tmp_path / 'begun'}; exec sleep 60"]
    waits.component.work = lambda job: futures.append((job, isolated.runner.submit(replace(job, function=subprocess.run, arguments=(hang,)))))
    waits.component.on_plan_perch(request(), answers.append)
    (job, future), = futures
    while not (tmp_path / "begun").exists():
        time.sleep(0.01)
    killed = isolated.runner.pid
    os.kill(killed, signal.SIGKILL)
    job.then(future.exception(120.0))
    assert answers[0].error_code == PerchPlanError.SOLVER and "ended" in answers[0].message
    while isolated.runner.pid == killed:
        time.sleep(0.01)
    assert isolated.runner.wait_ready()  # its start does not count against the limit of a plan
    assert isolated(request()).success


def test_what_nobody_had_foreseen_is_a_refusal(ask: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise IndexError("list index out of range")

    monkeypatch.setattr(perching_planner.planner, "plan", broken)
    plan = ask(request())
    assert plan.error_code == PerchPlanError.SOLVER and "IndexError: list index out of range" in plan.message


@pytest.mark.parametrize(("changes", "words"), [
    ({"thrust_ratio": 0.2}, "request: thrust_ratio: 0.2: total thrust 0.90 N cannot lift 0.25 kg"),
    ({"thrust_ratio": 2.0, "impact_acceleration": 0.0}, "impact_acceleration: 0 is outside")])
def test_what_a_request_asks_for_is_refused_by_its_own_name(ask: Asked, changes: dict, words: str) -> None:
    assert words in ask(request(**changes)).message


def test_the_heading_at_either_end_of_its_range_is_planned(ask: Asked) -> None:
    assert ask(request(yaw=1000.0)).success and ask(request(yaw=-1000.0)).success
    with pytest.raises(ConfigError, match=r"start: yaw_acc: 1e\+06 is outside \[-1000, 1000\] rad/s\^2"):
        StartState(np.zeros(3), yaw_acc=1e6)


@pytest.mark.skipif(not jit.COMPILED, reason="kernels are interpreted")
@pytest.mark.parametrize("limits", [{}, {"height_max": 1.0}, {"height_min": 2.0, "height_max": 9.0}, {"clearance_min": 2.0}])
def test_the_preload_loads_every_kernel_that_a_plan_calls(monkeypatch: pytest.MonkeyPatch, limits: dict) -> None:
    """Compiling one takes longer than `time_limit`: on a new checkout, plans that call it would never come."""
    called: set[Any] = set()
    call = jit._Compiled.__call__
    monkeypatch.setattr(jit._Compiled, "__call__", lambda kernel, *arguments: called.add(kernel) or call(kernel, *arguments))
    component = PerchingPlanner(PerchingPlannerParameters(**limits))
    component.warm_up()
    component.preload()()
    loaded = set(called)
    ceiling = PerchSurface.from_inclination(np.array([0.0, 0.0, 4.0]), math.pi)
    ask = planner(PerchingPlannerParameters())
    plan = ask(request(ceiling, p=np.array([0.0, 0.0, 3.96]), waypoints=np.array([[0.0, 0.0, 3.5]])))
    assert plan.iterations > 50 and ask(request(start=12_600_000_000, current=ask(request()).trajectory)).success
    assert {kernel.py_func.__name__ for kernel in called - loaded} == set()


def test_all_parameters_but_the_vehicle_may_change() -> None:
    asked = planner(PerchingPlannerParameters())
    assert "vehicle" not in PerchingPlanner.changeable and "duration_max" in PerchingPlanner.changeable
    asked.component.reconfigure(PerchingPlannerParameters(thrust_reserve=0.8))
    plan = asked(request())
    assert {c.quantity: c for c in plan.certificates}["thrust"].upper_limit == pytest.approx(0.8 * 4.0 * load_vehicle("snapdragon").thrust_max)


def test_an_unknown_vehicle_is_refused() -> None:
    with pytest.raises(ConfigError, match="no_such"):
        PerchingPlanner(PerchingPlannerParameters(vehicle="no_such"))
