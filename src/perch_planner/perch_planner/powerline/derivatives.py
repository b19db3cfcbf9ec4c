"""First and second derivatives of the whole problem, assembled from those of the stages.

CasADi would differentiate the sum over N compiled calls by its chain rule: 22 directions through every call and six
thousand nodes, 2.3 ms per iteration. Here every stage function is called once, mapped over the stages, and one gather
moves the nonzeros to their places: 0.5 ms. The results are the same; a test compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from perch_core.rotor_model import INPUTS, STATES
from perch_planner.powerline.stage_functions import STAGE_STATES, StageFunctions

STRIDE = STAGE_STATES + INPUTS


@dataclass(frozen=True)
class Parameters:
    """The problem's parameters as symbols: see `nlp.ProblemData`."""

    lines: Sequence[ca.MX]
    body_rate: ca.MX
    reference: ca.MX
    run: ca.MX
    end: ca.MX
    perception: ca.MX


class Gather:
    """A sparse matrix whose nonzeros are picked from one long vector of stage derivatives."""

    def __init__(self, rows: int, columns: int) -> None:
        self._shape = (rows, columns)
        self._rows: list[np.ndarray] = []
        self._columns: list[np.ndarray] = []
        self._source: list[np.ndarray] = []
        self._parts: list[ca.MX] = []
        self._length = 0

    def add(self, values: ca.MX, rows: np.ndarray, columns: np.ndarray, mirror: bool = False) -> None:
        """Put `values[i]` at (rows[i], columns[i]); with `mirror` also at the transposed place off the diagonal."""
        source = self._length + np.arange(len(rows))
        self._parts.append(values)
        self._length += len(rows)
        self._rows.append(rows)
        self._columns.append(columns)
        self._source.append(source)
        if mirror:
            off = rows != columns
            self._rows.append(columns[off])
            self._columns.append(rows[off])
            self._source.append(source[off])

    def matrix(self) -> ca.MX:
        """The matrix; values at the same place are added up."""
        rows, columns, source = map(np.concatenate, (self._rows, self._columns, self._source))
        sparsity, mapping = ca.Sparsity.triplet(*self._shape, rows.tolist(), columns.tolist(), False)
        all_values = ca.vertcat(*self._parts)
        if sparsity.nnz() == len(rows):
            return ca.MX(sparsity, all_values[source[np.array(mapping)].tolist()])
        # Several values at one place: a constant matrix of ones adds them, cheaper than a chain of sparse sums.
        place = {cell: k for k, cell in enumerate(zip(*[np.array(v) for v in sparsity.get_triplet()]))}
        target = [place[cell] for cell in zip(rows, columns)]
        adder = ca.DM.triplet(target, source.tolist(), ca.DM.ones(len(rows)), sparsity.nnz(), self._length)
        return ca.MX(sparsity, ca.mtimes(adder, all_values))


def _pattern(sparsity: ca.Sparsity) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = sparsity.get_triplet()
    return np.array(rows, int), np.array(columns, int)


def _tiled(pattern: tuple[np.ndarray, np.ndarray], row_step: int, column_step: int, count: int, row: int = 0, column: int = 0
           ) -> tuple[np.ndarray, np.ndarray]:
    """A pattern repeated along the stages."""
    k = np.arange(count)[:, None]
    return (row + k * row_step + pattern[0]).ravel(), (column + k * column_step + pattern[1]).ravel()


def split(x: ca.MX, N: int) -> tuple[ca.MX, ca.MX]:
    """States (18 x N + 1) and inputs (4 x N) of the stacked variables."""
    stages = ca.reshape(x[: N * STRIDE], STRIDE, N)
    return ca.horzcat(stages[:STAGE_STATES, :], x[N * STRIDE:]), stages[STAGE_STATES:, :]


@dataclass(frozen=True)
class Rows:
    """Row indices of the constraints: fatrop requires an interval's dynamics first, then other constraints of its first node.

    Attributes:
        dynamics: first of 18 rows of every interval, shape (N,).
        start: first of 17 rows of the start condition.
        between: row of the middle of every interval, shape (N,).
        inner: first row of the path constraints of nodes 1..N, shape (N,).
        end: first row of the values that vanish at the last node.
        count: number of all rows.
    """

    dynamics: np.ndarray
    start: int
    between: np.ndarray
    inner: np.ndarray
    end: int
    count: int


def constraint_rows(N: int, path: int, end: int) -> Rows:
    """Rows of a problem with N intervals, `path` constraints at every node but the first, and `end` more at the last."""
    first = STAGE_STATES + STATES + 1
    following = first + np.arange(N - 1) * (STAGE_STATES + path + 1)
    inner = np.append(following + STAGE_STATES, first + (N - 1) * (STAGE_STATES + path + 1))
    last = int(inner[-1]) + path
    return Rows(np.append(0, following), STAGE_STATES, np.append(first - 1, inner[:-1] + path), inner, last, last + end)


def path_functions(p: Parameters) -> list[tuple[str, ca.MX]]:
    """The path constraints of a node in their order, each with its parameter: every line's clearance, then the body rate."""
    return [*(("clearance", line) for line in p.lines), ("body_rate", p.body_rate)]


def end_size(stages: StageFunctions, end: str) -> int:
    """Number of constraints at the last node."""
    return int(stages.functions[end].size1_out(0)) if end else 0


def jacobian(stages: StageFunctions, x: ca.MX, p: Parameters, N: int, end: str) -> ca.MX:
    """Jacobian of all constraints; `end`: function that vanishes at the last node, "" where none does."""
    f, path = stages.functions, path_functions(p)
    X, U = split(x, N)
    at = constraint_rows(N, len(path), end_size(stages, end))
    out = Gather(at.count, N * STRIDE + STAGE_STATES)

    rows, columns = _pattern(stages.jacobian["step"])
    k = np.arange(N)[:, None]
    values = f["step_jac"].map(N)(X[:, :N], U, 1.0 / N)
    out.add(-ca.vec(values), (at.dynamics[:, None] + rows).ravel(), (k * STRIDE + columns).ravel())
    diagonal = np.arange(STAGE_STATES)
    out.add(ca.MX(ca.DM.ones(N * STAGE_STATES)), (at.dynamics[:, None] + diagonal).ravel(), ((k + 1) * STRIDE + diagonal).ravel())
    out.add(ca.MX(ca.DM.ones(STATES)), at.start + np.arange(STATES), np.arange(STATES))
    rows, columns = _pattern(stages.jacobian["body_rate_between"])
    values = f["body_rate_between_jac"].map(N)(X[:, :N], U, 1.0 / N, p.body_rate)
    out.add(ca.vec(values), (at.between[:, None] + rows).ravel(), (k * STRIDE + columns).ravel())
    for i, (name, parameter) in enumerate(path):
        rows, columns = _pattern(stages.jacobian[name])
        values = f[f"{name}_jac"].map(N)(X[:, 1:], parameter)
        out.add(ca.vec(values), (at.inner[:, None] + i + rows).ravel(), ((k + 1) * STRIDE + columns).ravel())
    if end:
        rows, columns = _pattern(stages.jacobian[end])
        out.add(f[f"{end}_jac"](X[:, N], p.reference), at.end + rows, N * STRIDE + columns)
    return out.matrix()


def hessian(stages: StageFunctions, x: ca.MX, p: Parameters, N: int, lam_f: ca.MX, lam_g: ca.MX, perception: bool,
            end: str, gauss_newton: bool = False) -> tuple[ca.MX, ca.MX]:
    """Gradient and full Hessian of the Lagrangian lam_f f + lam_g . g; `gauss_newton`: perception costs without curvature."""
    f, path = stages.functions, path_functions(p)
    X, U = split(x, N)
    at = constraint_rows(N, len(path), end_size(stages, end))
    size = N * STRIDE + STAGE_STATES
    out = Gather(size, size)
    pieces: list[tuple[ca.MX, int]] = []  # gradients of one function over the stages, and the first stage

    def add_terms(name: str, values: ca.MX, variables: int, first: int, number: int) -> None:
        pieces.append((values[:variables, :], first))
        places = _tiled(_pattern(stages.hessian[name]), STRIDE, STRIDE, number, first * STRIDE, first * STRIDE)
        out.add(ca.vec(values[variables:, :]), *places, mirror=True)

    lam_step = ca.reshape(lam_g[(at.dynamics[:, None] + np.arange(STAGE_STATES)).ravel().tolist()], STAGE_STATES, N)
    add_terms("step", f["step_hess"].map(N)(X[:, :N], U, 1.0 / N, -lam_step), STRIDE, 0, N)
    between = f["body_rate_between_hess"].map(N)(X[:, :N], U, 1.0 / N, p.body_rate, lam_g[at.between.tolist()].T)
    add_terms("body_rate_between", between, STRIDE, 0, N)
    add_terms("run", f["run_hess"].map(N)(X[:, :N], U, 1.0 / N, p.run, lam_f), STRIDE, 0, N)
    if perception:
        add_terms("perception", f["perception_gauss_newton" if gauss_newton else "perception_hess"].map(N)(
            X[:, :N], p.lines[0], p.perception, lam_f), STAGE_STATES, 0, N)
    for i, (name, parameter) in enumerate(path):
        values = f[f"{name}_hess"].map(N)(X[:, 1:], parameter, lam_g[(at.inner + i).tolist()].T)
        add_terms(name, values, STAGE_STATES, 1, N)
    add_terms("end", f["end_hess"](X[:, N], p.reference, p.end, lam_f), STAGE_STATES, N, 1)
    if end:
        add_terms(end, f[f"{end}_hess"](X[:, N], p.reference, lam_g[at.end:]), STAGE_STATES, N, 1)

    gradient = ca.MX.zeros(STRIDE, N + 1)
    for values, first in pieces:
        rows, number = values.shape
        gradient[:rows, first : first + number] += values
    gradient[:STAGE_STATES, 1:] += lam_step
    gradient[:STATES, 0] += lam_g[at.start : at.start + STATES]
    return ca.vec(gradient)[:size], out.matrix()
