"""Speed bars of the perching planner as it is shipped: plans with certificates, wrong verdicts."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec

import exact_sturm
import numpy as np
from harness import Figure, figure
from random_perches import paper_like_problem, shipped_settings

from perch_core import bernstein
from perch_core.vehicle import load_vehicle
from perch_eval.campaign.progress import with_progress
from perch_eval.campaign.workers import in_processes
from perch_planner import bounds
from perch_planner.planner import plan
from perch_planner.problem import PerchSettings
from perch_planner.refusals import PerchRefusal

SEEDS = "problems: from 0, one each; polynomials: from 0, one each"
_CHUNK = 100  # polynomials
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
    """Return wall-clock and CPU time of one plan for each of `count` random problems [ms], and the number of refusals."""
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


def _rotorpy_times(waypoints: int, count: int) -> tuple[np.ndarray, int]:
    """Return wall-clock times of RotorPy's minimum-snap trajectories through the same points [ms], and how many it did not find.

    It plans x, y, z and yaw as QPs with durations for 1 m/s and a speed limit in the middle of each segment; attitude at the end,
    thrust, rotors and clearance are not planned and not checked.
    """
    from rotorpy.trajectories.minsnap import MinSnap  # type: ignore[import-not-found,import-untyped]
    times, failed = [], 0
    for seed in range(count):
        points = paper_like_problem(np.random.default_rng(seed), waypoints).points
        begin = time.perf_counter()
        try:
            MinSnap(points, verbose=False)
            times.append(1e3 * (time.perf_counter() - begin))
        except TypeError:  # its solver's answer was None
            failed += 1
    return np.array(times), failed


def _additions() -> float:
    """Return the CPU time of a plain loop [s], a measure of the machine's present speed."""
    begin, total = time.process_time(), 0
    for k in range(10_000_000):
        total += k
    return time.process_time() - begin


def _first_plan(fresh: bool) -> tuple[float, float]:
    """Return import time and time of the first plan of a new process [s]; `fresh`: without cached kernels."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, **({"NUMBA_CACHE_DIR": folder} if fresh else {})}
        out = subprocess.run([sys.executable, "-c", _FIRST_PLAN], env=environment, capture_output=True, text=True, check=True)
    imported, first = out.stdout.split()
    return float(imported), float(first)


def _wrong(first: int) -> int:
    """Count wrong verdicts on `_CHUNK` polynomials with margins from 1e-2 to 1e-9, by Sturm's chain in exact arithmetic."""
    wrong = 0
    for seed in range(first, first + _CHUNK):
        rng = np.random.default_rng(seed)
        force = rng.normal(0.0, rng.uniform(1.0, 8.0), (3, 13))
        force[2] += 9.81
        poly = bernstein.product(force, force).sum(axis=0)
        attained, _, _ = bounds.maximum(poly, 1e-13 * np.abs(poly).max(), -np.inf)
        bound = attained * (1.0 + rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-9.0, -2.0))
        verdict, _ = bounds.stays_below(poly, bound)
        wrong += (verdict == bounds.BELOW) != exact_sturm.stays_below(poly.tolist(), bound)
    return wrong


def _wrong_verdicts(count: int) -> float:
    """Count verdicts on `count` polynomials, a multiple of 100, that the exact chain contradicts; on all processors but one."""
    starts = range(0, count, _CHUNK)
    found = in_processes(_wrong, starts, max(1, (os.cpu_count() or 1) - 1))
    return float(sum(wrong for _, wrong in with_progress(found, len(starts), lambda one: not one[1], unit=f"times {_CHUNK} verdicts")))


def _print_step(what: str) -> None:
    """Print what is measured next."""
    print(f"  {what} ...", file=sys.stderr, flush=True)


def figures(quick: bool) -> list[Figure]:
    """Measure the group; wall-clock times come first, without work in parallel."""
    count = 60 if quick else 400
    out, shipped = [], shipped_settings()
    _print_step(f"plans of {count} problems")
    for waypoints, median, p99 in ((0, 0.25, 1.0), (3, 0.5, 1.5), (10, 0.8, 2.5)):
        times, cpu, refused = _plan_times(waypoints, shipped, count)
        name = f"plan as shipped, {waypoints} waypoints"
        out += [figure(name, "ms", times, median), figure(f"{name}, p99", "ms", times, p99, "p99 <="),
                figure(f"{name}, CPU time", "ms", cpu), figure(f"{name}: refused of {count}", "problems", [refused])]
        if find_spec("rotorpy"):  # `.venv/bin/python -m pip install rotorpy`
            times, failed = _rotorpy_times(waypoints, count)
            out += [figure(f"RotorPy's MinSnap, {waypoints} waypoints, no limit of thrust", "ms", times),
                    figure(f"RotorPy's MinSnap, {waypoints} waypoints: not solved of {count}", "problems", [failed])]
    out.append(figure("ten million additions in plain Python, CPU time: the machine's speed", "s", [_additions()]))
    _print_step("first plans of a process")
    imported, first = _first_plan(fresh=False)
    out += [figure("import", "s", [imported]), figure("first plan of a process, kernels cached", "s", [first])]
    verdicts = 300 if quick else 10_000
    _print_step(f"{verdicts} verdicts" + ("" if quick else ", and the first plan of a checkout beside them"))
    with ThreadPoolExecutor(1) as beside:
        compiled = None if quick else beside.submit(_first_plan, fresh=True)
        wrong = _wrong_verdicts(verdicts)
        out.append(figure(f"wrong verdicts of {verdicts} polynomials, margins to 1e-9", "verdicts", [wrong], 0.0, "max =="))
        if compiled is not None:
            out.append(figure("first plan of a checkout, kernels compiled", "s", [compiled.result()[1]]))
    return out
