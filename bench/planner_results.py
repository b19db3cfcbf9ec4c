#!/usr/bin/env python3
"""Write Table I and Fig. 4 of M, reproduced, to docs/results/planner: `python3 bench/planner_results.py` inside setup.bash."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "bench"))

import planner_nonlinear
from random_perches import paper_like_problem

from perch_core import bernstein
from perch_core.surface import PerchSurface
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_planner.contact_constraints import Contact
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.refusals import PerchRefusal
from perch_planner.segment_program import ReducedSegments

VEHICLE = load_vehicle("snapdragon")
# M-V: thrust alone is bounded, at 4.5 N; tangential speed, rates and box are free; violating segments grow (eq. 17 ff.).
PAPER = dict(thrust_max=4.5, thrust_min=1e-3, tangential_speed_max=20.0, body_rate_max=1e3, height_min=-100.0,
             clearance_min=-100.0, cuts=False)


def fig_4(folder: Path, stretching: str) -> list[tuple[float, float]]:
    """Thrust over time for each iteration, from t_f = 1 s until 4.5 N hold."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    settings = PerchSettings(**PAPER, stretching=stretching)
    surface = PerchSurface.from_inclination(np.array([1.7, 0.0, 1.2]), np.radians(60.0))
    waypoints = tuple(Waypoint(p) for p in ((0.25, 0.03, 1.17), (0.75, -0.03, 1.1), (1.3, 0.03, 1.1)))
    problem = PerchProblem(StartState((0.0, 0.0, 1.2)), surface, waypoints, segment_times=(0.28, 0.22, 0.22, 0.28))
    durations, rows = np.array(problem.segment_times), []
    durations[-1] = max(durations[-1], settings.last_segment_min)
    figure, axis = pyplot.subplots(figsize=(7, 4.2), layout="constrained")
    for iteration in range(15):
        coefficients, solution = ReducedSegments(Contact(problem, settings, VEHICLE.perch_offset), durations, settings).solve()
        if not solution.solved:
            durations = 1.1 * durations
            continue
        peaks, begin = [], 0.0
        curve_t, curve = [], []
        for c, T in zip(coefficients, durations):
            s = np.linspace(0.0, 1.0, 80)
            force = bernstein.evaluate(bernstein.derivative(c, 2), s).T / T**2 + (0.0, 0.0, GRAVITY)
            thrust = VEHICLE.mass * np.linalg.norm(force, axis=1)
            curve_t.append(begin + T * s)
            curve.append(thrust)
            peaks.append(thrust.max())
            begin += T
        axis.plot(np.concatenate(curve_t), np.concatenate(curve), label=f"{iteration + 1}: t_f = {durations.sum():.2f} s")
        rows.append((float(durations.sum()), float(max(peaks))))
        violated = np.array(peaks) > 4.5
        if not violated.any():
            break
        if stretching == "segments":
            durations = np.where(violated, 1.1 * durations, durations)
        else:
            over, limit = max(peaks) / VEHICLE.mass, 4.5 / VEHICLE.mass
            durations = durations * min(max(((over - GRAVITY) / (limit - GRAVITY)) ** 0.5, 1.05), 1.6)
    axis.axhline(4.5, color="black", linestyle="--")
    axis.set(xlabel="time [s]", ylabel="thrust [N]", title=f"Fig. 4 of M: iterations of the bound check ({stretching})")
    axis.legend(fontsize=7)
    figure.savefig(folder / f"fig4_{stretching}.png", dpi=110)
    pyplot.close(figure)
    return rows


def table_1(count: int) -> list[str]:
    """Medians over random problems of the plan and of SLSQP at the same coordinates."""
    lines = ["| optimizer | waypoints | this machine, median [ms] | n | M, Table I [ms] |", "| --- | --- | --- | --- | --- |"]
    paper = {("QP + GBC", 3): 4, ("QP + GBC", 10): 18, ("NLopt SLSQP", 3): 527, ("NLopt SLSQP", 10): 1253}
    for waypoints in (3, 10):
        fast, slow, settings = [], [], PerchSettings()
        for seed in range(count):
            problem = paper_like_problem(np.random.default_rng(seed), waypoints)
            try:
                planned = plan(problem, settings, VEHICLE)
                fast.append(1e3 * planner_nonlinear.plan_time(problem, settings, VEHICLE))
            except PerchRefusal:
                continue
            elapsed, converged, _ = planner_nonlinear.solve(problem, settings, VEHICLE, 0.95 * planned.trajectory.durations)
            if converged:
                slow.append(1e3 * elapsed)
        for name, times in (("QP + GBC", fast), ("NLopt SLSQP", slow)):
            lines.append(f"| {name} | {waypoints} | {np.median(times):.2f} | {len(times)} | {paper[name, waypoints]} |")
        published = paper["NLopt SLSQP", waypoints] / paper["QP + GBC", waypoints]
        lines.append(f"| ratio | {waypoints} | {np.median(slow) / np.median(fast):.0f} | | {published:.0f} |")
    return lines


def main() -> int:
    """Write the page and its pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "planner", help="folder (default: %(default)s)")
    parser.add_argument("--count", type=int, default=20, help="problems per row of the table (default: %(default)s)")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    page = ["# The planner against the paper's Table I and Fig. 4", "",
            "Generated by `bench/planner_results.py`. Each plan counts with its certificates; SLSQP bounds the thrust at every",
            "10 ms in the same reduced coordinates, at 0.95 of the plan's durations, from the QP's solution. CPU times.", "",
            *table_1(arguments.count), "",
            "Fig. 4 starts, as in M, from 1 s in all for three waypoints, with the thrust bounded at 4.5 N and nothing else",
            "beyond eqs. 11, 14 and 15; M ends at 1.4 s. Stretching only the violating segments need not end.", ""]
    for stretching in ("whole", "segments"):
        rows = fig_4(arguments.out, stretching)
        title = {"whole": "the whole trajectory stretched", "segments": "violating segments stretched, as in M"}[stretching]
        page += [f"## Fig. 4, {title}", "",
                 f"![thrust over the iterations](fig4_{stretching}.png)", "",
                 "| t_f [s] | greatest thrust [N] |", "| --- | --- |", *(f"| {t:.3f} | {peak:.3f} |" for t, peak in rows), ""]
    (arguments.out / "table1_fig4.md").write_text("\n".join(page))
    print("\n".join(page))
    return 0


if __name__ == "__main__":
    sys.exit(main())
