"""Speed bars of the perching planner: plans with certificates, the OSQP path, wrong verdicts, the nonlinear comparison."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import planner_nonlinear
from harness import Figure, figure
from planner_verdicts import wrong_verdicts
from random_perches import paper_like_problem

from perch_core.vehicle import load_vehicle
from perch_planner.planner import plan
from perch_planner.problem import PerchSettings
from perch_planner.refusals import PerchRefusal

_FIRST_PLAN = """
import time; begin = time.perf_counter()
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
vehicle = load_vehicle("snapdragon"); imported = time.perf_counter() - begin
begin = time.perf_counter()
plan(PerchProblem(StartState((0, 0, 1.2)), PerchSurface.from_inclination((1.7, 0, 1.2), 1.2)), PerchSettings(), vehicle)
print(imported, time.perf_counter() - begin)
"""


def _plan_times(waypoints: int, settings: PerchSettings, count: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Wall-clock and CPU time of one plan for each of `count` random problems [ms], and how many were refused."""
    vehicle, times, refused = load_vehicle("snapdragon"), [], 0
    for seed in range(count):
        problem = paper_like_problem(np.random.default_rng(seed), waypoints)
        try:
            if not seed:
                plan(problem, settings, vehicle)
            begin, cpu = time.perf_counter(), time.process_time()
            plan(problem, settings, vehicle)
            times.append((1e3 * (time.perf_counter() - begin), 1e3 * (time.process_time() - cpu)))
        except PerchRefusal:
            refused += 1
    wall, cpu = np.array(times).T
    return wall, cpu, refused


def _additions() -> float:
    """CPU time of a plain loop [s]: what this machine is worth at this moment."""
    begin, total = time.process_time(), 0
    for k in range(10_000_000):
        total += k
    return time.process_time() - begin


def _nonlinear_ratios(waypoints: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """CPU time of SLSQP over that of the plan with its certificates, and of SLSQP alone [ms], on problems both solve."""
    vehicle, settings = load_vehicle("snapdragon"), PerchSettings()
    ratios, times = [], []
    for seed in range(count):
        problem = paper_like_problem(np.random.default_rng(seed), waypoints)
        try:
            planned = plan(problem, settings, vehicle)
            fast = planner_nonlinear.plan_time(problem, settings, vehicle)
        except PerchRefusal:
            continue
        slow, converged, _ = planner_nonlinear.solve(problem, settings, vehicle, 0.95 * planned.trajectory.durations)
        if converged:
            ratios.append(slow / fast)
            times.append(1e3 * slow)
    return np.array(ratios), np.array(times)


def _first_plan(fresh: bool) -> tuple[float, float]:
    """Import time and time of the first plan of a new process [s]; fresh: without cached kernels."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, **({"NUMBA_CACHE_DIR": folder} if fresh else {})}
        out = subprocess.run([sys.executable, "-c", _FIRST_PLAN], env=environment, capture_output=True, text=True, check=True)
    imported, first = out.stdout.split()
    return float(imported), float(first)


def _say(what: str) -> None:
    """Name what is measured next."""
    print(f"  {what} ...", file=sys.stderr, flush=True)


def figures(quick: bool) -> list[Figure]:
    """Measure the group; what counts by the clock first, and alone."""
    count = 60 if quick else 400
    out = []
    _say(f"plans of {count} problems")
    for waypoints, median, p99 in ((3, 0.5, 1.0), (10, 1.0, 2.0)):
        times, cpu, refused = _plan_times(waypoints, PerchSettings(), count)
        name = f"plan with certificates, {waypoints} waypoints"
        out += [figure(name, "ms", times, median), figure(f"{name}, p99", "ms", times, p99, "p99 <="),
                figure(f"{name}, CPU time", "ms", cpu), figure(f"{name}: refused of {count}", "problems", [refused])]
    _say("plans with OSQP")
    for waypoints, bar in ((3, 15.0), (10, 30.0)):
        times, _, _ = _plan_times(waypoints, PerchSettings(solver="osqp"), count // 4)
        out.append(figure(f"plan with OSQP, {waypoints} waypoints", "ms", times, bar))
    _say("plans without waypoints and within single rotors' limits")
    times, _, _ = _plan_times(0, PerchSettings(), count)
    out.append(figure("plan with certificates, no waypoints", "ms", times))
    times, cpu, _ = _plan_times(3, PerchSettings(rotors="preferred"), count // 4)
    out += [figure("plan within single rotors' limits, 3 waypoints", "ms", times),
            figure("plan within single rotors' limits, 3 waypoints, CPU time", "ms", cpu)]
    out.append(figure("ten million additions in plain Python, CPU time: the machine's speed", "s", [_additions()]))
    _say("SLSQP")
    for waypoints in (3, 10):
        ratios, times = _nonlinear_ratios(waypoints, 4 if quick else 12)
        if len(ratios):
            out += [figure(f"SLSQP with sampled thrust, {waypoints} waypoints", "ms", times),
                    figure(f"SLSQP / plan, {waypoints} waypoints", "x", ratios, 50.0, "median >=")]
    _say("first plans of a process")
    imported, first = _first_plan(fresh=False)
    out += [figure("import", "s", [imported]), figure("first plan of a process, kernels cached", "s", [first])]
    verdicts = 300 if quick else 10_000
    _say(f"{verdicts} verdicts" + ("" if quick else ", and the first plan of a checkout beside them"))
    with ThreadPoolExecutor(1) as beside:
        compiled = None if quick else beside.submit(_first_plan, fresh=True)
        wrong = wrong_verdicts(verdicts)
        out.append(figure(f"wrong verdicts of {verdicts} polynomials, margins to 1e-9", "verdicts", [wrong], 0.0, "max =="))
        if compiled is not None:
            out.append(figure("first plan of a checkout, kernels compiled", "s", [compiled.result()[1]]))
    return out
