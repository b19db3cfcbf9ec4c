"""Bars of the powerline planner: solve times, share of random starts solved, published durations.

    python3 scripts/bench.py powerline            1,000 starts of the five cases and 2,000 anywhere, some ten minutes
    python3 scripts/bench.py powerline --quick    50 and 100

With the settings of `config/powerline_planner.yaml`.

Solve times are processor time, which other load on the machine hardly affects.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from unittest import mock

import numpy as np
import powerline_ipopt
from harness import Figure, figure

from perch_core import config, so3
from perch_core.errors import PlanningRefusal
from perch_core.rotor_model import P, Q, V
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.campaign.progress import with_progress
from perch_eval.evaluation.powerline import PUBLISHED, PUBLISHED_TOLERANCE
from perch_eval.node_launch import read_parameters
from perch_planner.powerline import problem
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.solving import Solver
from perch_planner.powerline.starts import random_start
from perch_planner.powerline.visibility import visibility
from perch_planner.powerline_planner import PowerlinePlannerParameters

SEEDS = "starts of the five cases: 2026; starts anywhere: 2027 with their number"
SOLVE_BARS = {"line_20": 15.0, "line_80": 20.0, "line_20_pa": 30.0, "line_80_pa": 30.0, "line_180": 40.0}  # medians; p99: twice that [ms]
ORACLE_SAMPLE = 20  # of the planned starts anywhere, to see what that IPOPT finds
END_UNITS = {"end_position": "m", "end_tilt": "deg", "end_speed": "m/s"}  # without bars: less accurate plans are refused


def figures(quick: bool) -> list[Figure]:
    """Measure everything; `quick`: 10 starts per case instead of 200, and 100 anywhere instead of 2,000."""
    vehicle = load_vehicle("rpg")
    out = [figure("compilation", "s", [_compile_time()], bar=30.0, comparison="max <=")]
    starts, random_starts = (10, 100) if quick else (200, 2000)
    answers = _answers(vehicle, _of_cases(vehicle, starts), starts * len(SOLVE_BARS))
    for case, bar in SOLVE_BARS.items():
        plans = [answer for answer in answers if answer["case"] == case and not answer["missing"]]
        out += [figure(f"{case} perch solve", "ms", [plan["perch_ms"] for plan in plans], bar=bar),
                figure(f"{case} perch solve p99", "ms", [plan["perch_ms"] for plan in plans], bar=2 * bar, comparison="p99 <="),
                figure(f"{case} recovery solve", "ms", [plan["recovery_ms"] for plan in plans], bar=70.0),
                figure(f"{case} perch iterations", "-", [plan["iterations"] for plan in plans])]
    plans = [answer for answer in answers if not answer["missing"]]  # as in the evaluation: with a recovery
    out += [figure("every perch solve", "ms", [plan["perch_ms"] for plan in plans], bar=250.0, comparison="max <="),
            figure("every perch solve, wall clock", "ms", [plan["wall_ms"] for plan in plans]),
            figure("random starts solved", "%", [100.0 * len(plans) / len(answers)], bar=99.5, comparison="min >=")]
    out += [figure(name, unit, [plan[name] for plan in plans]) for name, unit in END_UNITS.items()]
    anywhere = _answers(vehicle, _anywhere(vehicle, random_starts), random_starts)
    plans = [answer for answer in anywhere if "perch_ms" in answer]
    oracle = powerline_ipopt.Oracle(vehicle, shipped_settings())
    known = sum(oracle.perch(answer["request"]) is not None for answer in anywhere if "perch_ms" not in answer)
    sample = [oracle.perch(answer["request"]) is not None for answer in plans[::max(1, len(plans) // ORACLE_SAMPLE)]]
    out += [figure("starts anywhere, 0-180 deg, planned", "%", [100.0 * len(plans) / len(anywhere)]),
            figure("the same, of those that it or a multi-start IPOPT plans", "%", [100.0 * len(plans) / (len(plans) + known)], bar=99.5,
                   comparison="min >="),
            figure("planned starts where that IPOPT plans", "%", [100.0 * np.mean(sample)]),
            figure("starts anywhere, without recovery", "-", [sum(np.isnan(plan["recovery_ms"]) for plan in plans)]),
            figure("starts anywhere, perch", "ms", [plan["perch_ms"] for plan in plans])]
    for answer in answers + anywhere:
        if answer["missing"]:
            print(f"refused: {answer['case']}: {answer['missing']}")
    return out + _published() + _perception()


def shipped_settings() -> PowerlinePlannerParameters:
    """The planner's settings in `config/powerline_planner.yaml`."""
    return config.from_mapping(PowerlinePlannerParameters, read_parameters("powerline_planner"), "powerline_planner.yaml")


def _answers(vehicle: Vehicle, requests: Iterable[tuple[str, PowerlineRequest]], total: int) -> list[dict]:
    """Return the planner's answers to named requests."""
    planner = PowerlinePlanner(vehicle, shipped_settings())
    planner.warm_up()
    answers = ({"case": case, "request": request, **_answer(planner, request)} for case, request in requests)
    return list(with_progress(answers, total, lambda answer: "perch_ms" in answer, unit="starts"))


def _of_cases(vehicle: Vehicle, starts: int) -> Iterator[tuple[str, PowerlineRequest]]:
    """Yield `starts` random starts of each case."""
    for case in SOLVE_BARS:
        setup, rng = problem.load(f"powerline_{case}"), np.random.default_rng(2026)
        nominal = setup.request(vehicle)
        for _ in range(starts):
            yield case, random_start(nominal, setup, vehicle, rng)


def _anywhere(vehicle: Vehicle, starts: int) -> Iterator[tuple[str, PowerlineRequest]]:
    """Yield perches at 0 to 180 deg on any of three wires, from starts 2 to 5 m in front of them, with and without perception."""
    nominal = problem.load("powerline_line_80").request(vehicle)
    for number in range(starts):
        rng = np.random.default_rng([2027, number])
        line, start = nominal.lines[rng.integers(len(nominal.lines))], nominal.start.copy()
        start[P] = line.centre + [-rng.uniform(2.0, 5.0), rng.uniform(-1.5, 1.5), 0.0]
        start[2] = rng.uniform(2.0, 6.0)
        start[Q] = so3.quat_exp(np.array([0.0, 0.0, rng.uniform(-0.8, 0.8)]))
        start[V] = rng.uniform(-0.5, 0.5, 3)
        point, pitch = line.centre + rng.uniform(-0.5, 0.5) * line.direction, rng.uniform(0.0, np.pi)
        perch = PerchPose.on_line(line, point, pitch, vehicle.wire_offset, start[P])
        yield (f"anywhere {number}, line {line.id}, {np.degrees(pitch):.0f} deg",
               replace(nominal, start=start, target_line=line.id, perch=perch, perception=bool(rng.integers(2)), deadline=10.0))


def _answer(planner: PowerlinePlanner, request: PowerlineRequest) -> dict:
    """Return times, iterations and end errors of a plan; without a recovery, its time is nan.

    `missing` is the reason why there is no plan, the only value then, or no recovery; empty: there are both.
    """
    try:
        plan = planner.plan(request)
    except PlanningRefusal as refusal:
        return {"missing": str(refusal)}
    return {"missing": "" if plan.recovery else f"no recovery: {plan.without_recovery}",
            "perch_ms": 1e3 * plan.perch.cpu_time, "recovery_ms": 1e3 * plan.recovery.cpu_time if plan.recovery else np.nan,
            "wall_ms": 1e3 * plan.perch.solve_time, "iterations": plan.perch.iterations,
            **{bound.quantity: bound.maximum for bound in plan.perch.bounds if bound.quantity in END_UNITS}}


def _compile_time() -> float:
    """Return the processor time to the first ready solver on a machine without compiled code [s]."""
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, PERCH_CACHE=folder):
        begin = os.times()
        Solver(load_vehicle("rpg"))
        end = os.times()
    return sum(end[:4]) - sum(begin[:4])


def _published() -> list[Figure]:
    out = []
    for name, duration in PUBLISHED.items():
        planned = problem.plan(problem.load(f"powerline_{name}"))
        out.append(figure(f"{name}: |T - {duration}|", "s", [abs(planned.plan.perch.duration - duration)], bar=PUBLISHED_TOLERANCE, comparison="max <="))
    return out


def _perception() -> list[Figure]:
    """Visibility with and without perception awareness, from the same starts."""
    out = []
    for case in ("deg90_perception", "line_80_pa", "line_20_pa"):
        for perception in (True, False):
            planned = problem.plan(problem.load(f"powerline_{case}"), perception=perception, with_recovery=False)
            summary = visibility(planned.plan.perch.states, planned.request.target(), planned.vehicle.mounts["front"]).summary()
            name = f"{case} {'with' if perception else 'without'}"
            bar = {"bar": 0.99, "comparison": "min >="} if perception and case == "deg90_perception" else {}
            out += [figure(f"{name}: cheirality", "-", [summary["cheirality_share"]], **bar),
                    figure(f"{name}: segment visible", "-", [summary["segment_share"]]),
                    figure(f"{name}: line in image", "-", [summary["seen_share"]]),
                    figure(f"{name}: |reprojection|", "px", [summary["mean_reprojection_px"]])]
    return out
