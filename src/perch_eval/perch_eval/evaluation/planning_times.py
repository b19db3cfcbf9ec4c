"""[M] Table I and Fig. 4: how long planning takes, and how the thrust shrinks while the time is stretched."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from perch_core import bernstein
from perch_core.surface import PerchSurface
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle
from perch_eval.evaluation.nonlinear import solve
from perch_eval.evaluation.sections import Effort, Section
from perch_eval.statistics import Spread
from perch_planner.contact_constraints import Contact
from perch_planner.planner import PerchPlan, plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.refusals import PerchRefusal
from perch_planner.segment_program import FORMULATIONS

THRUST_MAX = 4.5                                  # [N], the paper's
PAPER = {3: (4.0, 527.0), 10: (18.0, 1253.0)}     # waypoints -> (QP+GBC, NLOPT) [ms]
REPETITIONS = 5  # of each problem; the fastest counts, so that other work on the machine does not
# The paper bounds the thrust alone, and stretches the time until it is kept.
PAPERS_LIMITS = {"cuts": False, "height_min": -50.0, "extension": 0.0, "body_rate_max": 1e3, "speed_max": 1e3, "tangential_speed_max": 10.0}


def waypoint_problem(rng: np.random.Generator, waypoints: int) -> PerchProblem:
    """A wall 3 m away with random waypoints on the way, total time 1 s to begin with, as in the paper's experiment."""
    start, pad = np.array([0.0, 0.0, 1.2]), np.array([3.0, 0.0, 1.4])
    shares = np.linspace(0.0, 0.75, waypoints + 2)[1:-1]
    points = [start + s * (pad - start) + rng.normal(0.0, 0.25, 3) / math.sqrt(waypoints) for s in shares]
    return PerchProblem(StartState(start), PerchSurface.from_inclination(pad, math.radians(90.0)),
                        tuple(Waypoint(p) for p in points), segment_times=(1.0 / (waypoints + 1),) * (waypoints + 1))


def planning_sections(effort: Effort) -> list[Section]:
    """Table I and Fig. 4."""
    vehicle = load_vehicle("snapdragon")
    return [_table(effort, vehicle), _figure(effort, vehicle)]


def _table(effort: Effort, vehicle: Vehicle) -> Section:
    count = 50 if effort.full else 5
    out = Section("m_table_1", "[M] Table I: planning time",
                  f"{count} problems with random waypoints for each row (seeds 0 to {count - 1}), first duration 1 s, thrust at most "
                  f"{THRUST_MAX} N, order 14; median [range] over the problems of wall-clock times on this machine, compilation left out, "
                  f"the fastest of {REPETITIONS} for the QP. "
                  "The paper averages 5 runs of OOQP and NLopt on a board of 2018.")
    settings, every_limit = PerchSettings(thrust_max=THRUST_MAX, **PAPERS_LIMITS), PerchSettings(thrust_max=THRUST_MAX)
    for waypoints, (paper_qp, paper_nlp) in PAPER.items():
        problems = [waypoint_problem(np.random.default_rng(seed), waypoints) for seed in range(count)]
        plans = [_timed(p, settings, vehicle) for p in problems]
        solved = [(p, found) for p, found in zip(problems, plans) if found is not None]
        ours = Spread.of(1e3 * found.solve_time for _, found in solved)
        out.data[f"qp_{waypoints}"] = [found.solve_time for _, found in solved]
        out.claim(f"QP + global bound check, {waypoints} waypoints", ours.words(1.0, 2, "ms"), f"{paper_qp:g} ms",
                  len(solved) == count and ours.median <= paper_qp,
                  f"all {count} problems solved, median at most the paper's" if len(solved) == count
                  else f"only {len(solved)} of {count} problems were solved")
        strict = [_timed(p, every_limit, vehicle) for p in problems]
        proved = Spread.of(1e3 * found.solve_time for found in strict if found is not None)
        out.compare(f"the same with every limit of ours proved, {waypoints} waypoints", proved.words(1.0, 2, "ms"), f"{paper_qp:g} ms",
                    proved.median <= paper_qp, f"{proved.count} of {count} planned; also floor, rim, slip, speed and body rates")
        nonlinear = [solve(p, settings, vehicle, found.trajectory.durations, THRUST_MAX) for p, found in solved[:20]]
        times = Spread.of(1e3 * n.solve_time for n in nonlinear)
        out.data[f"nonlinear_{waypoints}"] = [n.solve_time for n in nonlinear]
        done = sum(n.converged for n in nonlinear)
        out.show(f"nonlinear program (NLopt SLSQP), {waypoints} waypoints", times.words(1.0, 0, "ms"), f"{paper_nlp:g} ms",
                 f"{done} of {len(nonlinear)} converged; durations are given to it, which the paper's had to find")
        ratio = times.median / ours.median
        out.claim(f"nonlinear / QP, {waypoints} waypoints", f"{ratio:.0f} x", f"{paper_nlp / paper_qp:.0f} x", ratio >= 10.0,
                  "the QP with the paper's limits is at least ten times as fast")
    return out


def _timed(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> PerchPlan | None:
    """The fastest of several equal plans, or None where there is none."""
    try:
        return min((plan(problem, settings, vehicle) for _ in range(REPETITIONS)), key=lambda found: found.solve_time)
    except PerchRefusal:
        return None


def _figure(effort: Effort, vehicle: Vehicle) -> Section:
    """Fig. 4: thrust over time at each duration on the way to a plan that keeps its bound."""
    out = Section("m_fig_4", "[M] Fig. 4: the thrust shrinks while the time is stretched",
                  "A wall 3 m away from a hover, first duration 1 s, minimum snap; the time is stretched, as in the paper, until "
                  f"the thrust stays below {THRUST_MAX} N everywhere (proved, not sampled). Without noise: no seed.")
    surface = PerchSurface.from_inclination(np.array([3.0, 0.0, 1.2]), math.radians(90.0))
    problem = PerchProblem(StartState(np.array([0.0, 0.0, 1.2])), surface, segment_times=(1.0,))
    settings = PerchSettings(thrust_max=THRUST_MAX, **PAPERS_LIMITS)
    try:
        found = plan(problem, settings, vehicle)
    except PerchRefusal as refusal:
        out.claim("iterations end", f"refused: {refusal}", "t_f = 1.4 s", False, "stretching ends in a plan")
        return out
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    peaks = [a.thrust_max for a in found.attempts]
    for k, attempt in enumerate(found.attempts):
        t, thrust = _thrust(problem, settings, vehicle, attempt.duration)
        axes.plot(t, thrust, lw=1.4, label=f"{k + 1}: {attempt.duration:.2f} s, peak {attempt.thrust_max:.2f} N")
    axes.axhline(THRUST_MAX, color="k", lw=0.8, ls="--", label=f"bound {THRUST_MAX} N")
    axes.set_xlabel("time [s]")
    axes.set_ylabel("thrust [N]")
    axes.set_ylim(0.0, min(1.05 * max(peaks), 6 * THRUST_MAX))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.savefig(effort.out / "m_fig_4.png", dpi=110)
    out.figures.append(("m_fig_4.png", "Thrust over time in each iteration"))
    falls = all(b < a for a, b in zip(peaks, peaks[1:]))
    out.claim("peak thrust in each iteration", " > ".join(f"{p:.2f}" for p in peaks) + " N", "shrinks in each", falls,
              "each iteration has a lower peak")
    out.claim("peak of the last iteration", f"{peaks[-1]:.3f} N", f"<= {THRUST_MAX} N", peaks[-1] <= THRUST_MAX, "the bound is kept")
    out.show("final duration", f"{found.duration:.2f} s", "1.4 s", "the paper does not say where its start and target are")
    return out


def _thrust(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Thrust over time of the QP's solution for a duration."""
    from perch_planner.time_allocation import split_last

    durations = split_last(np.array([duration]))
    coefficients, _ = FORMULATIONS[settings.formulation](Contact(problem, settings, vehicle.perch_offset), durations, settings).solve()
    times, values, begin = [], [], 0.0
    for segment, length in zip(coefficients, durations):
        s = np.linspace(0.0, 1.0, 200)
        second = bernstein.derivative(segment, 2) / length**2
        a = (second @ bernstein.basis(second.shape[-1] - 1, s).T).T
        times.append(begin + s * length)
        values.append(vehicle.mass * np.linalg.norm(a + np.array([0.0, 0.0, GRAVITY]), axis=1))
        begin += length
    return np.concatenate(times), np.concatenate(values)
