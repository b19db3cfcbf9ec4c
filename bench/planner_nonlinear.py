"""Table I of M: the thrust bound enforced at every sample by NLopt's SLSQP, in the planner's own reduced coordinates."""

from __future__ import annotations

import time

import numpy as np

from perch_core import bernstein
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner import reduced_qp
from perch_planner.contact_constraints import Contact
from perch_planner.planner import plan
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.reduced_qp import ReducedProgram
from perch_planner.reduced_rows import rows_of
from perch_planner.solvers import least_norm

SAMPLE = 0.01  # [s], the paper's dt


def plan_time(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> float:
    """CPU time of one plan with its certificates [s], the median of five."""
    times = []
    for _ in range(5):
        begin = time.process_time()
        plan(problem, settings, vehicle)
        times.append(time.process_time() - begin)
    return float(np.median(times))


def _accelerations(program: ReducedProgram, segments: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """a + g e3 at places as constant + columns @ w of each dimension: shapes (places, 3), (places, size)."""
    size = len(program.spread)
    slopes = bernstein.basis(12, places)

    def at(w):
        second = bernstein.derivative(reduced_qp.coefficients(program, w), 2) / program.durations[:, None, None] ** 2
        return np.einsum("kdi,ki->kd", second[segments], slopes)

    constant = at(np.zeros(3 * size))
    columns = np.stack([(at(unit) - constant)[:, 0] for unit in np.eye(size, 3 * size)], axis=1)
    return constant + (0.0, 0.0, GRAVITY), columns


def solve(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, durations: np.ndarray,
          time_limit: float = 20.0) -> tuple[float, bool, float]:
    """Minimise the same cost with the thrust bounded at every 10 ms as a nonlinear constraint. [M:V, Table I]

    Args:
        problem, settings, vehicle: as for the planner.
        durations: fixed segment durations [s].
        time_limit: of the solver [s].

    Returns:
        CPU time [s], which other programs do not stretch, whether the solver converged within the bounds, greatest sampled thrust [N].
    """
    import nlopt

    contact = Contact(problem, settings, vehicle.perch_offset)
    linear = contact.constraints(durations)
    bubbles = contact.bubbles(durations, everywhere=False)
    times = np.arange(0.0, durations.sum(), SAMPLE)
    edges = np.concatenate([[0.0], np.cumsum(durations)])
    segments = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(durations) - 1)
    places = (times - edges[segments]) / durations[segments]
    program = reduced_qp.assemble(durations, *contact.knots(durations), bubbles, 4)
    rows, low, high = rows_of(program, linear)
    size = len(program.spread)
    constant, columns = _accelerations(program, segments, places)
    limit = Limits.of(settings, vehicle).thrust[1] / vehicle.mass

    def cost(w, gradient):
        if gradient.size:
            gradient[:] = 2.0 * w
        return float(w @ w)

    def within_rows(result, w, gradient):
        value = rows @ w
        result[:] = np.concatenate([value - high, low - value])
        if gradient.size:
            gradient[:] = np.vstack([rows, -rows])

    def within_thrust(result, w, gradient):
        force = constant + columns @ w.reshape(3, size).T
        result[:] = (force**2).sum(axis=1) / limit**2 - 1.0
        if gradient.size:
            for d in range(3):
                gradient[:, d * size:(d + 1) * size] = 2.0 * force[:, d:d + 1] * columns / limit**2

    begin = time.process_time()
    solver = nlopt.opt(nlopt.LD_SLSQP, 3 * size)
    solver.set_min_objective(cost)
    solver.add_inequality_mconstraint(within_rows, np.full(2 * len(low), 1e-8))
    solver.add_inequality_mconstraint(within_thrust, np.full(len(times), 1e-6))
    solver.set_ftol_rel(1e-6)
    solver.set_maxtime(time_limit)
    try:
        w = solver.optimize(least_norm(rows, low, high).w)
        converged = solver.last_optimize_result() in (nlopt.SUCCESS, nlopt.FTOL_REACHED, nlopt.XTOL_REACHED)
    except (nlopt.RoundoffLimited, RuntimeError):
        w, converged = np.zeros(3 * size), False
    elapsed = time.process_time() - begin
    force = constant + columns @ w.reshape(3, size).T
    peak = float(np.sqrt((force**2).sum(axis=1)).max())
    return elapsed, bool(converged and peak <= 1.001 * limit), peak * vehicle.mass
