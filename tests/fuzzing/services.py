"""Requests to the planners, goals and departures for the mission, laws, aborts and parameters for the controller: in process, spoilt.

Every request is answered within its deadline. What makes no sense is answered with its typed error; a plan that is returned begins where
it was asked to, ends at the target, and keeps the vehicle's rotors within their range: judged here from the trajectory alone.
"""

from __future__ import annotations

import json
import math
import random
import time
import traceback
from collections.abc import Callable
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from perch_core import config, so3
from perch_core.component import Component
from perch_core.errors import ConfigError, PerchError
from perch_core.isolated import IsolatedRunner
from perch_core.ros import topics
from perch_core.trajectory import FlatSample, FlatTrajectory, SampledTrajectory
from perch_core.values import (
    MappedPowerline, PerchGoal, PerchPlan, PerchPlanRequest, PowerlinePlan, PowerlinePlanRequest, SetControllerRequest, TriggerRequest,
    seconds)
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle
from fuzzing import messages, sense
from fuzzing.messages import Nonsense
from fuzzing.report import Report
from fuzzing.spoiled import Way, in_effect, senseless, some_way, spoilt
from fuzzing.streams import Event, component, recorded

PATIENCE = 15.0   # for an answer: the longest deadline of a planner, and some [s]
NO_CERTIFICATE = 1.02  # rotor thrusts of a flat trajectory are looked at as the collective thrust alone
TASKS = {"plan_perch": "perching_planner", "plan_way_out": "perching_planner", "plan_powerline": "powerline_planner", "goal": "mission",
         "set_controller": "controller", "parameters": "controller", "abort": "controller", "depart": "mission"}
SHARES = (*("plan_perch",) * 12, *("plan_way_out",) * 6, "plan_powerline", *("goal",) * 6, *("set_controller",) * 2, *("parameters",) * 6,
          "abort", "depart")
FREE = {"plan_perch": ("current", "start_time"), "plan_way_out": ("current", "start_time"),
        "plan_powerline": ("start_time", "lines.0.covariance", "lines.0.direction_sigma", "lines.0.observations", "perch_pose")}
"""Task -> fields that mean nothing in the requests here; a planner has no clock: any time may be planned for, and the controller
refuses to fly what does not begin now."""


@lru_cache(maxsize=None)
def good(task: str) -> Any:
    """A request that makes sense, as a message."""
    row = topics.service(task)
    if task in ("plan_perch", "plan_way_out"):
        tilt = np.array([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)])
        motion = {"v": np.array([1.0, 0.0, 0.3]), "a": np.array([1.0, 0.0, 0.0])} if task == "plan_way_out" else {}
        return row.request_message(PerchPlanRequest(start=10**9, p=np.array([0.0, 0.0, 1.2]), p_WS=np.array([1.7, 0.0, 1.2]), q_WS=tilt,
                                                    waypoints=np.zeros((0, 3)), **motion))
    wires = tuple(MappedPowerline(k, (4.0 + k, -2.0, 4.7), (4.0 + k, 2.0, 4.7), 0.01, 1e-4 * np.eye(3), 0.01, 30) for k in (0, 3))
    return row.request_message(PowerlinePlanRequest(start=10**9, p=np.array([0.0, 0.0, 4.3]), q=np.array([0.0, 0.0, 0.0, 1.0]), lines=wires,
                                                    perch_point=np.array([4.0, 0.0, 4.7]), perch_pitch=math.radians(20.0), deadline=10.0))


# -- plans -------------------------------------------------------------------------------------------------------------


def judge_plan(task: str, request: Any, answer: Any, vehicle: Vehicle) -> None:
    """Make sure that an answer of a planner makes sense.

    Raises:
        Nonsense: it does not.
    """
    if not answer.success:
        if not answer.error_code or not answer.message or "failed: " in answer.message and "Error" in answer.message:
            raise Nonsense(f"no typed refusal: code {answer.error_code}, {answer.message!r}")
        return
    if not abs(answer.trajectory.start_time - seconds(request.start)) < 1e-6:
        raise Nonsense(f"starts at {answer.trajectory.start_time} s, not at {seconds(request.start)} s")
    for problem in sense.nonsense(replace(answer.trajectory, start_time=0.0), math.inf, "trajectory"):  # a time is as large as the clock's
        raise Nonsense(problem)
    {"plan_perch": _judge_perch, "plan_way_out": _judge_way_out, "plan_powerline": _judge_sampled}[task](request, answer, vehicle)
    broken = [str(c) for c in answer.certificates if not c.holds]
    if broken:
        raise Nonsense(f"a plan with a broken bound: {broken}")


def _judge_flat(request: PerchPlanRequest, answer: PerchPlan, vehicle: Vehicle) -> FlatSample:
    """Make sure of the thrust and of the start.

    Returns:
        The samples that were looked at.
    """
    t: FlatTrajectory = answer.trajectory
    x = t.sample_many(np.linspace(0.0, t.duration, 200))
    thrust = vehicle.mass * np.linalg.norm(x.a + [0.0, 0.0, GRAVITY], axis=1)
    highest = 4.0 * vehicle.thrust_max if request.thrust_max is None else min(request.thrust_max, 4.0 * vehicle.thrust_max)
    lowest = max(4.0 * vehicle.thrust_min, request.thrust_min or 0.0)
    if thrust.max() > NO_CERTIFICATE * highest or thrust.min() < lowest / NO_CERTIFICATE:
        raise Nonsense(f"thrust [{thrust.min():.2f}, {thrust.max():.2f}] N beyond [{lowest:.2f}, {highest:.2f}] N")
    if request.current is None:
        _near("start position", x.p[0], request.p, 1e-3), _near("start velocity", x.v[0], request.v, 1e-3)
        _near("start acceleration", x.a[0], request.a, 1e-2)
    return x


def _judge_way_out(request: PerchPlanRequest, answer: PerchPlan, vehicle: Vehicle) -> None:
    x = _judge_flat(request, answer, vehicle)
    _near("velocity of the hover", x.v[-1], np.zeros(3), 1e-3), _near("acceleration of the hover", x.a[-1], np.zeros(3), 1e-2)
    surface = np.asarray(request.p_WS) + np.linspace(0.0, answer.trajectory.duration, 200)[:, None] * np.asarray(request.target_velocity)
    away = (x.p - surface) @ so3.quat_rotate(request.q_WS, np.array([0.0, 0.0, 1.0]))
    if away[-1] < 0.2 or away.min() < min(away[0], 0.0) - 1e-3:
        raise Nonsense(f"a way out that ends {away[-1]:.3f} m before the surface and comes as near as {away.min():.3f} m")


def _judge_perch(request: PerchPlanRequest, answer: PerchPlan, vehicle: Vehicle) -> None:
    x = _judge_flat(request, answer, vehicle)
    t: FlatTrajectory = answer.trajectory
    s3 = so3.quat_rotate(request.q_WS, np.array([0.0, 0.0, 1.0]))
    target = np.asarray(request.p_WS) + t.duration * np.asarray(request.target_velocity)
    away = float((x.p[-1] - target) @ s3)
    _near("contact", x.p[-1] - away * s3, target, 0.05)
    if not 0.0 <= away <= 0.5:
        raise Nonsense(f"ends {away:.3f} m above the surface")
    closing = -float((x.v[-1] - request.target_velocity) @ s3)
    if not -1e-3 <= closing <= 20.0:
        raise Nonsense(f"touches with {closing:.3f} m/s")


def _judge_sampled(request: PowerlinePlanRequest, answer: PowerlinePlan, vehicle: Vehicle) -> None:
    t: SampledTrajectory = answer.trajectory
    if t.rotor_thrust.max() > vehicle.thrust_max + 0.01 or t.rotor_thrust.min() < vehicle.thrust_min - 0.01:
        raise Nonsense(f"rotor thrusts [{t.rotor_thrust.min():.3f}, {t.rotor_thrust.max():.3f}] N beyond the rotors' range")
    _near("start position", t.p[0], request.p, 1e-2), _near("start velocity", t.v[0], request.v, 1e-2)
    moved = np.linalg.norm(np.diff(t.p, axis=0) - 0.5 * (t.v[1:] + t.v[:-1]) * np.diff(t.times)[:, None], axis=1)
    if moved.max() > 0.01:
        raise Nonsense(f"position jumps by {moved.max():.3f} m")
    for line in request.lines:
        if line.id != request.target_line and float(line.segment.distance(t.p).min()) < min(vehicle.body_radii):
            raise Nonsense(f"passes through line {line.id}")


def _near(what: str, a: np.ndarray, b: np.ndarray, most: float) -> None:
    if not np.linalg.norm(np.asarray(a) - np.asarray(b)) <= most:
        raise Nonsense(f"{what} {np.asarray(a)} is not {np.asarray(b)}")


class Planners:
    """Both planners, each with a process for its jobs as on a graph."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[Component[Any], IsolatedRunner]] = {}

    def ask(self, task: str, ways: list[Way]) -> str:
        """Send a spoilt request.

        Returns:
            `planned`, or `refused`.

        Raises:
            Nonsense: no answer in time, or one that makes no sense.
        """
        flight = "line" if task == "plan_powerline" else "surface"
        if task not in self._of:
            one = component(flight, TASKS[task])
            runner = IsolatedRunner(one.preload())
            while not runner.wait_ready():  # its start does not count against an answer
                pass
            one.work = lambda job: runner.submit(job).add_done_callback(lambda done: job.then(done.exception() or done.result()))
            self._of[task] = one, runner
        one, _ = self._of[task]
        message = spoilt(good(task), ways)
        strict = _counts(message, ways) and any(
            senseless(way) and in_effect(way, good(task), message) and not ".".join(map(str, way.path)).startswith(FREE[task]) for way in ways)
        try:
            request = topics.service(task).request_value(message)
        except PerchError:
            return "refused"
        answers: list[Any] = []
        began = time.monotonic()
        getattr(one, f"on_{task}")(request, answers.append)
        while not answers and time.monotonic() < began + PATIENCE:
            time.sleep(0.001)
        if len(answers) != 1:
            raise Nonsense(f"{len(answers)} answers within {PATIENCE:g} s")
        answer = answers[0]
        if strict and (answer.success or answer.error_code != 1 and not (task == "plan_powerline" and answer.error_code == 2)):
            raise Nonsense(f"nonsense was answered with code {answer.error_code}: {answer.message}")
        judge_plan(task, request, answer, load_vehicle(one.config.vehicle))
        return "planned" if answer.success else "refused"

    def close(self) -> None:
        """End the processes."""
        for _, runner in self._of.values():
            runner.close()


def _counts(message: Any, ways: list[Way]) -> bool:
    """Whether what was spoilt is looked at: NaN in an option of a perch leaves it to the planner, and there may be no line left."""
    names = [way.path[0] for way in ways]
    if any(name in ("impact_acceleration", "impact_speed_min", "impact_speed_max", "thrust_max", "thrust_min") for name in names):
        return False
    return not (hasattr(message, "lines") and (not message.lines or getattr(message, "recovery_only", False)))


# -- the mission and the controller ------------------------------------------------------------------------------------


class _Sent:
    """A goal as the mission sees it."""

    def __init__(self, value: PerchGoal) -> None:
        self.value, self.cancel_requested, self.result, self.feedback = value, False, None, lambda told: None

    def finish(self, ending: str, result: Any) -> None:
        """It ends."""
        self.result = result


def _some_goal(rng: random.Random) -> tuple[PerchGoal, bool]:
    """A goal, and whether it makes no sense."""
    values: dict[str, Any] = {"mode": rng.choice((0, 0, 0, 1, 2, 9, 255)), "attempts": rng.choice((0, 1, 3, 2**32 - 1)), "replan": rng.random() < 0.5}
    bad = values["mode"] in (2, 9, 255) or values["attempts"] > 100  # an inspection needs waypoints
    for name, sensible, rest in (("takeoff_height", (math.nan, 1.2, 9.9), (math.inf, 0.0, -1.0, 1e308)),
                                 ("search_timeout", (math.nan, 5.0), (-1.0, 0.0, math.inf)),
                                 ("inclination_hint", (math.nan, 1.5), (4.0, -1.0, math.inf)), ("perch_pitch", (0.0, 3.1), (math.nan, -0.1, 7.0)),
                                 ("search_frame", ("", "", "map"), ("odom", "x" * 9999)),
                                 ("perch_point", ((4.0, 0.0, 4.2),), ((math.nan, 0.0, 0.0), (1e308,) * 3)),
                                 ("search_position", ((0.0, 0.0, 1.0),), ((math.inf, 0.0, 1.0), (0.0, 0.0, -5.0), (1e9, 0.0, 1.0)))):
        wrong = rng.random() < 0.1
        values[name] = rng.choice(rest if wrong else sensible)
        bad |= wrong and (name != "search_position" or values.get("search_frame") == "map")
    return PerchGoal(**values), bad


def _settled(flight: str, name: str, rng: random.Random) -> tuple[messages._Played, list[Event]]:
    """A component somewhere in a flight, and what comes next."""
    one, events = messages._Played(flight, name), list(recorded(flight)[name])
    now = rng.randrange(len(events) - 200)
    for event in events[:now]:
        if event.method != "on_perch":
            one.call(event.method, messages._handed(event))
    return one, [event for event in events[now: now + 200] if event.method != "on_perch"]


def ask_mission(rng: random.Random) -> str:
    """Goals and departures at any time of a flight: one goal is taken, nonsense ends with BAD_GOAL, everything is answered."""
    one, later = _settled("surface", "mission", rng)
    mission, outcome = one.component, "taken"
    flown: Callable[[], bool] = lambda: False  # whether what was taken last is still under way
    for event in later[:20]:
        if rng.random() < 0.3:
            answers: list[Any] = []
            busy = flown()
            one.call("on_depart", (TriggerRequest(), answers.append))
            if busy != bool(answers):
                raise Nonsense(f"depart while {'a goal is flown' if busy else 'nothing is flown'}: {answers}")
            if not busy:
                flown = lambda answers=answers: not answers
        goal, bad = _some_goal(rng)
        sent, busy = _Sent(goal), flown()
        said = mission.on_perch(sent)
        if busy != bool(said):
            raise Nonsense(f"a goal while {'another is flown' if busy else 'nothing is flown'}: {said!r}")
        if not busy and bad != (sent.result is not None and sent.result.error_code == 7):
            raise Nonsense(f"{goal} {'makes no sense' if bad else 'makes sense'}: {sent.result}")
        if not busy and not bad:
            flown = lambda sent=sent: sent.result is None
        outcome = "refused" if bad else outcome
        one.call(event.method, messages._handed(event))
    for event in later[20:]:
        one.call(event.method, messages._handed(event))
    return outcome


def ask_controller(task: str, rng: random.Random) -> str:
    """A law, an abort or parameters in flight; what is refused has its code, and the flight goes on in sense."""
    one, later = _settled("surface", "controller", rng)
    controller, answers, outcome = one.component, [], "taken"
    if task == "set_controller":
        kind = rng.choice(("geometric", "nmpc", "", "pid", "x" * 10_000, "geometric\x00", "GEOMETRIC"))
        one.call("on_set_controller", (SetControllerRequest(kind, rng.random() < 0.5), answers.append))
        if len(answers) != 1 or answers[0].success != (answers[0].error_code == 0) or (answers[0].success and kind not in ("geometric", "nmpc")):
            raise Nonsense(f"{kind[:20]!r}: {answers}")
        outcome = "taken" if answers[0].success else "refused"
    elif task == "abort":
        one.call("on_abort", (TriggerRequest(), answers.append))
        if len(answers) != 1:
            raise Nonsense(f"{len(answers)} answers to an abort")
    else:
        outcome = _reconfigure(controller, rng)
    for event in later:
        one.call(event.method, messages._handed(event))
    return outcome


def leaves(value: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted name -> value of a tree of parameters."""
    found: dict[str, Any] = {}
    for item in fields(value):
        entry = getattr(value, item.name)
        found |= leaves(entry, f"{prefix}{item.name}.") if hasattr(entry, "__dataclass_fields__") else {f"{prefix}{item.name}": entry}
    return found


def _reconfigure(one: Component[Any], rng: random.Random) -> str:
    """Some parameters as a caller may set them."""
    flat = leaves(one.config)
    for name in rng.sample(sorted(flat), rng.choice((1, 1, 2, 5))):
        old = flat[name]
        number = isinstance(old, float)
        flat[name] = rng.choice((math.nan, math.inf, -1.0, 0.0, 1e-9, 1e9, "x", [], True, *((old * 0.5, old * 1.5, old * 10.0) if number else ())))
        if isinstance(old, tuple) and rng.random() < 0.5:
            flat[name] = [rng.choice((math.nan, 0.0, -1.0, 1e9, 5.0)) for _ in old]
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in flat.items()}
    try:
        changed = config.from_mapping(type(one.config), config.nested(plain), "controller")
        one.reconfigure(changed)
    except ConfigError:
        return "refused"
    except PerchError as error:
        raise Nonsense(f"refused without a place: {error!r}") from None
    return "taken"


# -- hunting -----------------------------------------------------------------------------------------------------------


def ask(planners: Planners | None, task: str, seed: int, ways: list[Way] | None = None) -> str:
    """One request of a seed.

    Args:
        planners: None where the task needs none.
        task: of `TASKS`.
        seed: of what is asked.
        ways: what is done to a good request of a planner; None: by the seed.

    Raises:
        Nonsense: the answer makes none.
    """
    rng = random.Random(seed)
    try:
        if task.startswith("plan"):
            return planners.ask(task, drawn(task, rng) if ways is None else ways)
        return ask_mission(rng) if task in ("goal", "depart") else ask_controller(task, rng)
    except Nonsense:
        raise
    except Exception:
        raise Nonsense(f"{task}: {traceback.format_exc()}") from None


def drawn(task: str, rng: random.Random) -> list[Way]:
    """What is done to a good request."""
    message, ways = good(task), []
    for _ in range(rng.choice((1, 1, 2, 3))):
        way = some_way(message, rng)
        if way.path[0] == "current":
            continue
        ways.append(way)
    return ways


def replay(case: str) -> None:
    """Ask once more what was found.

    Raises:
        Nonsense: it is answered with nonsense still.
    """
    found, planners = json.loads(case), Planners()
    try:
        ways = found.get("ways")
        ask(planners, found["task"], found["seed"], None if ways is None else [Way(tuple(path), kind, value) for path, kind, value in ways])
    finally:
        planners.close()


def run(minutes: float, seed: int, report: Report) -> None:
    """Hunt. The planners' jobs run in processes that can be killed, as on a graph; the rest has been flown before."""
    rng, planners = random.Random(seed), Planners()
    try:
        while report.going():
            task, number = rng.choice(SHARES), rng.randrange(2**31)
            try:
                began = time.process_time()
                report.tried(f"{task} {ask(planners, task, number)}")
                if (took := time.process_time() - began) > messages.HUNG:
                    raise Nonsense(f"{task} took {took:.1f} s")
            except Nonsense as error:
                ways = drawn(task, random.Random(number)) if task.startswith("plan") else None
                report.found(f"{task}.json", json.dumps({"task": task, "seed": number, "ways": ways}).encode(), f"{task}: {error}")
    finally:
        planners.close()
