"""Planning for aggressive perching as in section IV-C of paper M: solve a QP, check the thrust, lengthen the durations.

This module serves comparison with the text. The shipped planner, `perch_planner.planner`, plans the same perches with cuts,
in a smaller program, and keeps every limit. Where the printed text cannot be used as it stands, the code differs from it:

* each polynomial is written in the Bernstein basis on its own segment instead of powers of t: with powers no solver meets
  the end conditions;
* the tube [M:eq15] is sorted, as the printed inequality swaps its bounds where a component is negative, and keeps a least
  half width, as it closes where a component is zero;
* s3 is the *outward* normal, so the speed of impact [M:eq14] is -v . s3;
* Algorithm 1 also checks the least thrust, with reversed signs;
* "adding time to violating segments" terminates in 17 of 24 problems with waypoints (those of Table I), and in none of 12
  with factor 1.1, as their neighbours keep the speed high; the neighbours therefore grow too, which terminates in all 20 tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import comb
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from perch_core import bernstein
from perch_core.errors import ConfigError
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.active_set import least_norm
from perch_planner.contact_constraints import TUBE_FLOOR, TUBE_SHARE, TUBE_STEP
from perch_planner.paper import sturm
from perch_planner.problem import Limits, PerchProblem, PerchSettings, contact_heading

N = 14            # order of the polynomials [M:eq3]
SMOOTH = 4        # continuous up to this derivative [M:eq7]
STRETCH = 1.2     # of a violating segment and its neighbours; the paper does not say, but its Fig. 4 goes from 1 to 1.4 s
PROGRAMS_MAX = 100  # of a plan
E3 = np.array([0.0, 0.0, 1.0])
_DERIVATIVES = tuple(bernstein.derivative(np.eye(N + 1), order) for order in range(SMOOTH + 1))  # of the basis


def row(order: int, s: float, duration: float) -> np.ndarray:
    """Order-th derivative of the basis at t - t_(i-1) = s duration, (15,); times c_id it is that of p_id. [M:eq6, M:eq17]"""
    derivative: np.ndarray = _DERIVATIVES[order] @ bernstein.basis(N - order, s) / duration**order
    return derivative


def cost_matrix(duration: float, j: int) -> np.ndarray:
    """Q_i: integral of the j-th derivative of the basis times its transpose over a segment, shape (15, 15). [M:eq5]"""
    return _unit_cost(j) * duration ** (1 - 2 * j)


@lru_cache
def _unit_cost(j: int) -> np.ndarray:
    n = N - j
    products = [[comb(n, i) * comb(n, k) / comb(2 * n, i + k) / (2 * n + 1) for k in range(n + 1)] for i in range(n + 1)]
    cost: np.ndarray = _DERIVATIVES[j] @ np.array(products) @ _DERIVATIVES[j].T
    return cost


def place(vector: np.ndarray, segment: int, f: int) -> np.ndarray:
    """Embed a row of one segment in the coefficients of all segments, shape (15 f,)."""
    out = np.zeros((f, N + 1))
    out[segment] = vector
    return out.ravel()


def equalities(durations: np.ndarray, knots: Sequence[dict[int, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """A_d and b_d of all dimensions: imposed derivatives at the knots [M:eq6], and continuity there. [M:eq7]

    Args:
        durations: of the segments [s], shape (f,).
        knots: for each of t_0 ... t_f the imposed derivatives, order -> value of each dimension.

    Returns:
        A, shape (r, 15 f), the same for every dimension, and b, shape (r, dimensions).
    """
    f, rows, right = len(durations), [], []
    for k, imposed in enumerate(knots):
        before = [place(row(order, 1.0, durations[k - 1]), k - 1, f) for order in range(SMOOTH + 1)] if k else None
        after = [place(row(order, 0.0, durations[k]), k, f) for order in range(SMOOTH + 1)] if k < f else None
        for order, value in imposed.items():
            rows.append((after or before or [])[order])
            right.append(np.atleast_1d(value))
        if before and after:
            rows += [b - a for b, a in zip(before, after)]
            right += (SMOOTH + 1) * [np.zeros_like(right[0])]
    return np.array(rows), np.array(right)


def impact_window(R_WS: np.ndarray, settings: PerchSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """v_min <= -x'(t_f) . s3 <= v_max: direction, shape (1, 3), and bounds [m/s]. [M:eq14]"""
    return -R_WS[:, 2:].T, np.array([settings.impact_speed_min]), np.array([settings.impact_speed_max])


def tube(R_WS: np.ndarray, settings: PerchSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(1 -+ q)(alpha s3 - g e3) around x''(t): lower and upper bounds [m/s^2], shape (3,), and t - t_f of its instants [s]. [M:eq15]"""
    end = settings.impact_acceleration * R_WS[:, 2] - GRAVITY * E3
    half = np.maximum(TUBE_SHARE * np.abs(end), TUBE_FLOOR)
    count = int(np.ceil(settings.tube_time / TUBE_STEP - 1e-9))
    return end - half, end + half, -settings.tube_time + TUBE_STEP * np.arange(count)


def inequalities(durations: np.ndarray, R_WS: np.ndarray, settings: PerchSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """G, y and z of [M:eq8] for x, y and z together, as the window couples them: shapes (r, 3, 15 f), (r,), (r,)."""
    f = len(durations)
    directions, lower, upper = impact_window(R_WS, settings)
    velocity = place(row(1, 1.0, durations[-1]), f - 1, f)
    G, y, z = [direction[:, None] * velocity for direction in directions], [lower], [upper]
    least, most, instants = tube(R_WS, settings)
    knots = np.concatenate([[0.0], np.cumsum(durations)])
    for t in knots[-1] + instants:
        if t < 0.0:
            continue
        i = min(int(np.searchsorted(knots, t + 1e-12, side="right")) - 1, f - 1)
        acceleration = place(row(2, (t - knots[i]) / durations[i], durations[i]), i, f)
        G += [axis[:, None] * acceleration for axis in np.eye(3)]
        y.append(least)
        z.append(most)
    return np.array(G), np.concatenate(y), np.concatenate(z)


@dataclass(frozen=True)
class Program:
    """[M:eq8] in coordinates w in which A c = b holds and the cost is |w|^2: c_d = centre_d + spread w_d.

    Attributes:
        durations: of the segments [s], shape (f,).
        centre: the minimum without inequalities, shape (15 f, dimensions).
        spread: shape (15 f, m).
        rows, lower, upper: the inequalities in w, which stacks the dimensions; rows of unit length.
    """

    durations: np.ndarray
    centre: np.ndarray
    spread: np.ndarray
    rows: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def coefficients(self, w: np.ndarray) -> np.ndarray:
        """Bernstein coefficients, shape (f, dimensions, 15)."""
        c = self.centre + self.spread @ w.reshape(self.centre.shape[1], -1).T
        rows: np.ndarray = c.T.reshape(-1, len(self.durations), N + 1)
        return rows.transpose(1, 0, 2).copy()


def program(durations: np.ndarray, knots: Sequence[dict[int, Any]], j: int,
            bounds: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None) -> Program:
    """min c' Q c subject to A c = b and y <= G c <= z. [M:eq4, M:eq8]

    The equalities are eliminated by a null space of A, and its cost whitened by Cholesky: a solver then has a well-conditioned
    program. All dimensions share Q and A.

    Args:
        durations, knots: as for `equalities`.
        j: order of the derivative in the cost, 4 snap or 3 jerk.
        bounds: from `inequalities`; None: no inequalities.
    """
    f, n = len(durations), N + 1
    Q = np.zeros((n * f, n * f))
    for i, duration in enumerate(durations):
        Q[n * i:n * (i + 1), n * i:n * (i + 1)] = cost_matrix(duration, j)
    A, b = equalities(durations, knots)
    norms = np.linalg.norm(A, axis=1, keepdims=True)
    basis, triangle = np.linalg.qr((A / norms).T, mode="complete")
    r = len(A)
    particular = basis[:, :r] @ np.linalg.solve(triangle[:r].T, b / norms)
    null = basis[:, r:]
    factor = np.linalg.cholesky(null.T @ Q @ null)
    spread = np.linalg.solve(factor, null.T).T
    centre = particular - spread @ (spread.T @ (Q @ particular))
    if bounds is None:
        return Program(durations, centre, spread, np.zeros((0, spread.shape[1])), np.zeros(0), np.zeros(0))
    G, y, z = bounds
    rows, at = (G @ spread).reshape(len(G), -1), np.einsum("rdn,nd->r", G, centre)
    norms = np.linalg.norm(rows, axis=1)
    return Program(durations, centre, spread, rows / norms[:, None], (y - at) / norms, (z - at) / norms)


def position_program(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, durations: np.ndarray) -> Program:
    """The QP of x, y and z: start, waypoints, contact [M:eq6, M:eq11], window [M:eq14], tube [M:eq15]."""
    start, R_WS = problem.start, problem.surface.R_WS
    contact = problem.surface.p_WS + vehicle.perch_offset * R_WS[:, 2]
    knots = [{0: start.p, 1: start.v, 2: start.a, 3: start.j}, *({0: waypoint.p} for waypoint in problem.waypoints),
             {0: contact, 2: settings.impact_acceleration * R_WS[:, 2] - GRAVITY * E3}]
    return program(durations, knots, 4 if settings.objective == "snap" else 3, inequalities(durations, R_WS, settings))


def yaw_coefficients(problem: PerchProblem, settings: PerchSettings, durations: np.ndarray) -> np.ndarray:
    """Solve the QP of the heading, d = 4, at rest at the end with b2_des parallel to s2, shape (f, 15) [rad]. [M:eq8, M:eq12]"""
    start, end = problem.start, contact_heading(problem.surface)
    turn = start.yaw + (end - start.yaw + np.pi) % (2.0 * np.pi) - np.pi
    knots = [{0: start.yaw, 1: start.yaw_rate, 2: start.yaw_acc}, *({} for _ in problem.waypoints), {0: turn, 1: 0.0, 2: 0.0}]
    chosen = program(durations, knots, 4 if settings.objective == "snap" else 3)
    return chosen.coefficients(np.zeros(chosen.spread.shape[1]))[:, 0]


def squared_thrust(coefficients: np.ndarray, duration: float, mass: float) -> np.ndarray:
    """H(s) = |m x'' + m g e3|^2 of a segment in powers of s, degree 24, shape (25,) [N^2]. [M:eq9, M:eq16]"""
    force = mass * (bernstein.derivative(coefficients, 2) / duration**2 + GRAVITY * E3[:, None])
    return bernstein.to_powers(bernstein.product(force, force).sum(axis=0))


def keeps_thrust(coefficients: np.ndarray, duration: float, mass: float, low: float, high: float) -> bool:
    """Check tau_min^2 <= H <= tau_max^2 on a segment by Algorithm 1. [M:eq16, M:alg1]"""
    H = squared_thrust(coefficients, duration, mass)
    return bool(sturm.global_bound_check(H / high**2, 1.0, 0.0, 1.0) and sturm.global_bound_check(-H / high**2, -(low / high) ** 2, 0.0, 1.0))


class Iteration(NamedTuple):
    """One QP: its Bernstein coefficients of x, y, z, shape (f, 3, 15) [m], None without a solution; flags of the segments whose
    thrust leaves its bounds, shape (f,).
    """

    program: Program
    coefficients: np.ndarray | None
    violated: np.ndarray


class PaperPlan(NamedTuple):
    """Result of the procedure.

    Attributes:
        iterations: in order; where `solved`, the last one is the plan.
        trajectory: P_d(t), d = 1 ... 4, [M:eq3]; None where there is none.
        solved: the plan keeps the thrust bounds. [M:eq16]
        solve_time: CPU time [s].
    """

    iterations: tuple[Iteration, ...]
    trajectory: FlatTrajectory | None
    solved: bool
    solve_time: float


def plan(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> PaperPlan:
    """Solve the QP, check the thrust of each segment, lengthen violating segments and their neighbours, and repeat. [M:IV-C.3]

    Args:
        problem: with `segment_times`, the initial durations, and a static target.
        settings: alpha, v_min, v_max, tube, thrust bounds, objective and `duration_max`; others are ignored.
        vehicle: mass, thrust range and perch offset.

    Raises:
        ConfigError: the problem has no `segment_times`; the paper has no rule for them.
    """
    if problem.segment_times is None:
        raise ConfigError("problem", "segment_times", "are needed: the paper has no rule for the first durations")
    begin = process_time()
    low, high = Limits.of(settings, vehicle).thrust
    durations, solved = np.array(problem.segment_times, float), False
    done: list[Any] = []
    while not solved and durations.sum() <= settings.duration_max and len(done) < PROGRAMS_MAX:
        chosen = position_program(problem, settings, vehicle, durations)
        solution = least_norm(chosen.rows, chosen.lower, chosen.upper)
        coefficients, violated = None, np.ones(len(durations), bool)
        if solution.solved:
            coefficients = chosen.coefficients(solution.w)
            violated = np.array([not keeps_thrust(c, T, vehicle.mass, low, high) for c, T in zip(coefficients, durations)])
        done.append(Iteration(chosen, coefficients, violated))
        solved = not violated.any()
        grown = violated.copy()
        grown[1:] |= violated[:-1]
        grown[:-1] |= violated[1:]
        durations = np.where(grown, STRETCH * durations, durations)
    trajectory = None
    if solved:
        yaw = yaw_coefficients(problem, settings, chosen.durations)
        trajectory = FlatTrajectory(chosen.durations, np.concatenate([coefficients, yaw[:, None]], axis=1))
    return PaperPlan(tuple(done), trajectory, solved, process_time() - begin)
