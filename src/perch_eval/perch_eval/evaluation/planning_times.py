"""[M] Table I and Fig. 4: planning times, and the decrease of the thrust with time scaling."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from time import process_time
from typing import Any, NamedTuple

import nlopt
import numpy as np
from matplotlib.figure import Figure

from perch_core import bernstein
from perch_core.surface import PerchSurface
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle
from perch_eval.evaluation.document import Effort, Section
from perch_eval.statistics import Spread
from perch_planner import plan_checks, planner
from perch_planner.paper import paper_m
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.refusals import PerchRefusal

SETTINGS = PerchSettings(thrust_max=4.5)          # [N], the paper's
PAPER = {3: (4.0, 527.0), 10: (18.0, 1253.0)}     # waypoints -> (QP+GBC, NLOPT) [ms]
REPETITIONS = 5  # of each problem; the fastest counts, so that other work on the machine does not
SAMPLE = 0.01  # the thrust is bounded and drawn at every so many seconds, as the paper's dt [s]
TOLERANCE = 1e-6  # of the nonlinear program
TIME_LIMIT = 120.0  # of the nonlinear program [s]


def waypoint_problem(rng: np.random.Generator, waypoints: int) -> PerchProblem:
    """Return a problem as in the paper's experiment: a wall 3 m away, random waypoints, initial total time 1 s."""
    start, pad = np.array([0.0, 0.0, 1.2]), np.array([3.0, 0.0, 1.4])
    shares = np.linspace(0.0, 0.75, waypoints + 2)[1:-1]
    points = [start + s * (pad - start) + rng.normal(0.0, 0.25, 3) / math.sqrt(waypoints) for s in shares]
    return PerchProblem(StartState(start), PerchSurface.from_inclination(pad, math.radians(90.0)),
                        tuple(Waypoint(p) for p in points), segment_times=(1.0 / (waypoints + 1),) * (waypoints + 1))


def planning_sections(effort: Effort) -> list[Section]:
    """Return Table I and Fig. 4."""
    vehicle = load_vehicle("snapdragon")
    return [_table(effort, vehicle), _figure(effort, vehicle)]


def _table(effort: Effort, vehicle: Vehicle) -> Section:
    count = 50 if effort.full else 5
    out = Section("m_table_1", "[M] Table I: planning time",
                  f"{count} problems with random waypoints for each row (seeds 0 to {count - 1}), first duration 1 s, thrust at most "
                  f"{SETTINGS.thrust_max:g} N, order 14; median [range] over the problems of times on this machine, compilation left out, "
                  f"the fastest of {REPETITIONS}, but for the nonlinear program. As printed: `perch_planner/paper/paper_m.py`, numpy but for the "
                  "compiled QP solver and Sturm chains. "
                  "The paper averages 5 runs of OOQP and NLopt on a board of 2018.")
    for waypoints, (paper_qp, paper_nlp) in PAPER.items():
        problems = [waypoint_problem(np.random.default_rng(seed), waypoints) for seed in range(count)]
        printed = [found for p in problems if (found := _fastest(paper_m.plan, p, vehicle)).solved]
        out.data[f"qp_{waypoints}"] = [found.solve_time for found in printed]
        ends = Spread.from_values(1.0 * len(found.iterations) for found in printed)
        out.claim(f"Algorithm 1 (stretch segments that violate the bound) ends with a plan, {waypoints} waypoints", f"{len(printed)} of {count}", "all",
                  len(printed) == count, f"every problem is solved; {ends.median:.0f} QPs in the median")
        qp = Spread.from_values(1e3 * found.solve_time for found in printed)
        out.compare(f"QP + global bound check as printed, {waypoints} waypoints, CPU time", qp.to_text(1.0, 1, "ms"), f"{paper_qp:g} ms",
                    qp.median <= paper_qp)
        nonlinear = [solve(found.iterations[-1].program, vehicle.mass, SETTINGS.thrust_max) for found in printed[:20]]
        times = Spread.from_values(1e3 * n.solve_time for n in nonlinear if n.converged)
        out.data[f"nonlinear_{waypoints}"] = [n.solve_time for n in nonlinear]
        done = sum(n.converged for n in nonlinear)
        out.show(f"nonlinear program (NLopt SLSQP), {waypoints} waypoints, CPU time", times.to_text(1.0, 0, "ms"), f"{paper_nlp:g} ms",
                 f"{done} of {len(nonlinear)} converged; durations are given, which the paper's program had to find")
        ratio = times.median / qp.median
        out.compare(f"CPU time of the nonlinear program / QP as printed, {waypoints} waypoints", f"{ratio:.1f} x", f"{paper_nlp / paper_qp:.0f} x",
                    ratio >= paper_nlp / paper_qp,
                    "both ours, in Python; the paper's are its own two. Better: checking after the QP saves more time than in the paper")
        ours = [found for p in problems if (found := _fastest(planner.plan, replace(p, segment_times=None), vehicle)) is not None]
        out.data[f"shipped_{waypoints}"] = [found.solve_time for found in ours]
        shipped = Spread.from_values(1e3 * found.solve_time for found in ours)
        out.compare(f"shipped planner, {waypoints} waypoints, wall clock", shipped.to_text(1.0, 2, "ms"), f"{paper_qp:g} ms", shipped.median <= paper_qp,
                    f"{len(ours)} of {count} planned, from its own first durations; every limit proved, single rotors too")
    return out


def _fastest(plan: Callable[..., Any], problem: PerchProblem, vehicle: Vehicle) -> Any:
    """Repeat a plan and return the fastest result, or None if planning is refused."""
    try:
        return min((plan(problem, SETTINGS, vehicle) for _ in range(REPETITIONS)), key=lambda found: found.solve_time)
    except PerchRefusal:
        return None


def _figure(effort: Effort, vehicle: Vehicle) -> Section:
    """Return Fig. 4: thrust over time in each iteration until the plan keeps its bound."""
    bound = SETTINGS.thrust_max
    out = Section("m_fig_4", "[M] Fig. 4: the thrust shrinks while the time is stretched",
                  "A wall 3 m away from a hover, first duration 1 s, minimum snap; the time is stretched, as in the paper, until "
                  f"Algorithm 1 finds the thrust below {bound:g} N everywhere (`perch_planner/paper/paper_m.py`). Without noise: no seed.")
    surface = PerchSurface.from_inclination(np.array([3.0, 0.0, 1.2]), math.radians(90.0))
    problem = PerchProblem(StartState(np.array([0.0, 0.0, 1.2])), surface, segment_times=(1.0,))
    found = paper_m.plan(problem, SETTINGS, vehicle)
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    peaks = []
    for k, iteration in enumerate(found.iterations):
        if iteration.coefficients is None:
            continue
        durations = iteration.program.durations
        peaks.append(vehicle.mass * plan_checks.thrust_extrema(iteration.coefficients, durations, 0.0, bound / vehicle.mass)[2])
        t, f = specific_force(iteration.coefficients, durations)
        axes.plot(t, vehicle.mass * np.linalg.norm(f, axis=1), lw=1.4, label=f"{k + 1}: {t[-1]:.2f} s, peak {peaks[-1]:.2f} N")
    axes.axhline(bound, color="k", lw=0.8, ls="--", label=f"bound {bound:g} N")
    axes.set(xlabel="time [s]", ylabel="thrust [N]", ylim=(0.0, min(1.05 * max(peaks), 6 * bound)))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(effort.out / "m_fig_4.png", dpi=110)
    out.figures.append(("m_fig_4.png", "Thrust over time in each iteration"))
    falls = all(b < a for a, b in zip(peaks, peaks[1:])) if len(peaks) > 1 else None
    out.claim("peak thrust in each iteration", " > ".join(f"{p:.2f}" for p in peaks) + " N", "shrinks in each", falls,
              "each iteration has a lower peak")
    out.claim("peak of the last iteration", f"{peaks[-1]:.3f} N", f"<= {bound:g} N", found.solved and peaks[-1] <= bound,
              "the bound is kept: proved by subdivision, not sampled")
    if found.trajectory is None:
        out.missing("final duration", "1.4 s", "Algorithm 1 ends without a plan")
    else:
        out.show("final duration", f"{found.trajectory.duration:.2f} s", "1.4 s", "start and target are not given in the paper")
    return out


def specific_force(coefficients: np.ndarray, durations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s], at most `SAMPLE` apart, and the specific force there [m/s^2], shapes (n,), (n, 3)."""
    times, forces, begin = [], [], 0.0
    for segment, duration in zip(coefficients, durations):
        s = np.linspace(0.0, 1.0, max(2, math.ceil(duration / SAMPLE) + 1))
        times.append(begin + s * duration)
        forces.append((bernstein.evaluate(bernstein.derivative(segment, 2), s) / duration**2).T + (0.0, 0.0, GRAVITY))
        begin += duration
    return np.concatenate(times), np.concatenate(forces)


class NonlinearPlan(NamedTuple):
    """Solution of the nonlinear program.

    Attributes:
        coefficients: Bernstein, shape (f, 3, degree + 1) [m].
        thrust_max: greatest thrust at the samples [N].
        solve_time: CPU time, which does not depend on other processes [s].
        converged: whether the solution is within tolerances, before the time limit.
    """

    coefficients: np.ndarray
    thrust_max: float
    solve_time: float
    converged: bool


def solve(program: paper_m.Program, mass: float, thrust_max: float) -> NonlinearPlan:
    """Solve the comparison of the paper's Table I, one nonlinear program with the thrust bounded at every sample, by NLopt's SLSQP.

    The variables are the coordinates w of the paper's QP in which the equalities hold and the cost is |w|^2; with the Bernstein
    coefficients as variables the solver is slower (8-60 s).

    Args:
        program: program from `paper_m.position_program`.
        mass: mass of the vehicle [kg].
        thrust_max: bound [N].
    """
    begin = process_time()
    n = program.rows.shape[1]
    base = specific_force(program.coefficients(np.zeros(n)), program.durations)[1]
    slopes = np.stack([specific_force(program.coefficients(unit), program.durations)[1] - base for unit in np.eye(n)], axis=-1)
    limit = (thrust_max / mass) ** 2
    both, right = np.vstack([program.rows, -program.rows]), np.concatenate([program.upper, -program.lower])

    def cost(w: np.ndarray, gradient: np.ndarray) -> float:
        if gradient.size:
            gradient[:] = 2.0 * w
        return float(w @ w)

    def linear_rows(result: np.ndarray, w: np.ndarray, gradient: np.ndarray) -> None:
        if gradient.size:
            gradient[:] = both
        result[:] = both @ w - right

    def thrust_rows(result: np.ndarray, w: np.ndarray, gradient: np.ndarray) -> None:
        f = base + slopes @ w
        if gradient.size:
            gradient[:] = 2.0 * np.einsum("kd,kdn->kn", f, slopes) / limit
        result[:] = (f**2).sum(axis=1) / limit - 1.0

    solver = nlopt.opt(nlopt.LD_SLSQP, n)
    solver.set_min_objective(cost)
    solver.add_inequality_mconstraint(linear_rows, np.full(len(both), TOLERANCE))
    solver.add_inequality_mconstraint(thrust_rows, np.full(len(base), TOLERANCE))
    solver.set_ftol_rel(1e-6)
    solver.set_maxtime(TIME_LIMIT)
    try:
        w = solver.optimize(np.zeros(n))
        converged = solver.last_optimize_result() in (nlopt.SUCCESS, nlopt.FTOL_REACHED, nlopt.XTOL_REACHED)
    except (nlopt.RoundoffLimited, RuntimeError):
        w, converged = np.zeros(n), False
    peak = float(np.sqrt(((base + slopes @ w) ** 2).sum(axis=1).max()) * mass)
    converged = converged and peak <= thrust_max * 1.001 and float((both @ w - right).max()) < 1e-3
    return NonlinearPlan(program.coefficients(w), peak, process_time() - begin, converged)
