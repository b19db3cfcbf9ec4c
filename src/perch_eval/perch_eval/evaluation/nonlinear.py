"""Comparison of the paper's Table I: one nonlinear program with the thrust bounded at every sample. [M:V, Table I]

The variables are the coordinates w of the paper's QP in which the equalities hold and the cost is |w|^2; with the Bernstein
coefficients as variables the solver is slower (8-60 s).
"""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time

import nlopt
import numpy as np

from perch_core import bernstein
from perch_core.vehicle import GRAVITY
from perch_planner.paper.paper_m import Program

SAMPLE = 0.01  # the thrust is bounded at every so many seconds, as the paper's dt [s]
TOLERANCE = 1e-6
TIME_LIMIT = 120.0  # [s]


@dataclass(frozen=True)
class NonlinearPlan:
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


def solve(program: Program, mass: float, thrust_max: float) -> NonlinearPlan:
    """Solve the paper's program with the thrust bounded at every sample by NLopt's SLSQP.

    Args:
        program: program from `paper_m.position_program`.
        mass: mass of the vehicle [kg].
        thrust_max: bound [N].
    """
    begin = process_time()
    n = program.rows.shape[1]
    base, slopes = _acceleration_map(program, n)
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
    peak = float(np.sqrt(((base + slopes @ w) ** 2).sum(axis=1).max()) * mass)
    converged = converged and peak <= thrust_max * 1.001 and float((both @ w - right).max()) < 1e-3
    return NonlinearPlan(program.coefficients(w), peak, process_time() - begin, converged)


def _acceleration_map(program: Program, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return base and slopes of the specific force at the samples, base + slopes @ w: shapes (samples, 3), (samples, 3, n)."""
    origin = program.coefficients(np.zeros(n))
    base = _accelerations(origin, program.durations)
    slopes = np.stack([_accelerations(program.coefficients(unit) - origin, program.durations) for unit in np.eye(n)], axis=-1)
    base[:, 2] += GRAVITY
    return base, slopes


def _accelerations(coefficients: np.ndarray, durations: np.ndarray) -> np.ndarray:
    """Return accelerations at most `SAMPLE` apart [m/s^2], shape (samples, 3)."""
    out = []
    for segment, duration in zip(coefficients, durations):
        count = max(2, int(np.ceil(duration / SAMPLE)) + 1)
        out.append((bernstein.evaluate(bernstein.derivative(segment, 2), np.linspace(0.0, 1.0, count)) / duration**2).T)
    return np.concatenate(out)
