"""The paper's comparison for Table I: one nonlinear program with the thrust bounded at every sample. [M:eq16]

The reduced coordinates of the planner's own QP are used, so that the comparison is fair to the nonlinear program: in
the paper's coefficients it is slower still (8-60 s).
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import nlopt
import numpy as np

from perch_core import bernstein
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner import reduced_qp
from perch_planner.contact_constraints import Contact
from perch_planner.problem import PerchProblem, PerchSettings
from perch_planner.reduced_qp import ReducedProgram
from perch_planner.reduced_rows import rows_of
from perch_planner.segment_program import COST_ORDER

SAMPLE = 0.01  # the thrust is bounded at every so many seconds, as the paper's dt [s]
TOLERANCE = 1e-6
TIME_LIMIT = 120.0  # [s]


@dataclass(frozen=True)
class NonlinearPlan:
    """Answer of the nonlinear program.

    Attributes:
        coefficients: Bernstein, shape (f, 3, degree + 1) [m].
        thrust_max: greatest thrust at the samples [N].
        solve_time: wall-clock time [s].
        converged: within tolerances before the time limit.
    """

    coefficients: np.ndarray
    thrust_max: float
    solve_time: float
    converged: bool


def solve(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, durations: np.ndarray, thrust_max: float) -> NonlinearPlan:
    """NLopt's SLSQP on the reduced program with the thrust bounded at every sample.

    Args:
        problem: what is planned.
        settings: of the planner.
        vehicle: mass and perch offset.
        durations: of the segments [s], shape (f,).
        thrust_max: bound [N].
    """
    begin = perf_counter()
    contact = Contact(problem, settings, vehicle.perch_offset)
    linear = contact.constraints(durations)
    bubbles = contact.bubbles(durations, settings.objective == "jerk" or settings.bubbles == "everywhere")
    program = reduced_qp.assemble(durations, *contact.knots(durations), bubbles, COST_ORDER[settings.objective])
    rows, lower, upper = rows_of(program, linear)
    n = rows.shape[1]
    base, slopes = _acceleration_map(program, n)
    limit = (thrust_max / vehicle.mass) ** 2
    both, right = np.vstack([rows, -rows]), np.concatenate([upper, -lower])

    def cost(w: np.ndarray, gradient: np.ndarray) -> float:
        if gradient.size:
            gradient[:] = 2.0 * w
        return float(w @ w)

    def linear_rows(result: np.ndarray, w: np.ndarray, gradient: np.ndarray) -> None:
        if gradient.size:
            gradient[:] = both
        result[:] = both @ w - right

    def thrust_rows(result: np.ndarray, w: np.ndarray, gradient: np.ndarray) -> None:
        f = base + slopes @ w  # specific force at the samples, (samples, 3)
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
    peak = float(np.sqrt(((base + slopes @ w) ** 2).sum(axis=1).max()) * vehicle.mass)
    converged = converged and peak <= thrust_max * 1.001 and float((both @ w - right).max()) < 1e-3
    return NonlinearPlan(reduced_qp.coefficients(program, w), peak, perf_counter() - begin, converged)


def _acceleration_map(program: ReducedProgram, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Specific force at the samples as base + slopes @ w: shapes (samples, 3), (samples, 3, n)."""
    origin = reduced_qp.coefficients(program, np.zeros(n))
    columns = [reduced_qp.coefficients(program, unit) - origin for unit in np.eye(n)]
    base = _accelerations(origin, program.durations)
    base[:, 2] += GRAVITY
    return base, np.stack([_accelerations(c, program.durations) for c in columns], axis=-1)


def _accelerations(coefficients: np.ndarray, durations: np.ndarray) -> np.ndarray:
    """Accelerations every `SAMPLE`, shape (samples, 3)."""
    out = []
    for segment, duration in zip(coefficients, durations):
        count = max(2, int(np.ceil(duration / SAMPLE)) + 1)
        second = bernstein.derivative(segment, 2) / duration**2
        out.append((second @ bernstein.basis(second.shape[-1] - 1, np.linspace(0.0, 1.0, count)).T).T)
    return np.concatenate(out)
