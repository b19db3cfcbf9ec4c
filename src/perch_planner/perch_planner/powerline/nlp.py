"""The multiple-shooting problem and its solver: free duration, soft perception, hard avoidance and limits. [P:eq14]"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from perch_core.rotor_model import INPUTS, STATES
from perch_planner.powerline.derivatives import STRIDE, Parameters, constraint_rows, end_size, hessian, jacobian, path_functions, split
from perch_planner.powerline.stage_functions import (
    END_WEIGHTS, LINE_SIZE, PERCEPTION_WEIGHTS, REFERENCE, RUN_WEIGHTS, STAGE_STATES, StageFunctions,
)

_UNBOUNDED = np.inf
FINER = 16  # four times is still wrong by 1 to 3 mm at the end of 5 s


@dataclass(frozen=True)
class Structure:
    """Parameters that determine the sparsity of a problem; each structure has its own solver.

    Attributes:
        intervals: N.
        lines: number of segments to avoid; the first is the target.
        perception: whether the costs of [P:eq9, P:eq12, P:eq13] are part of the problem.
        end: stage function that vanishes at the last node, "perched" or "hovering"; "": none, the end only has costs.
        solver: "fatrop" or "ipopt".
    """

    intervals: int
    lines: int
    perception: bool
    end: str = ""
    solver: str = "fatrop"


@dataclass(frozen=True)
class ProblemData:
    """Data of one problem of a structure: all values that change from solve to solve.

    Attributes:
        start: x_init [P:eq14b], shape (17,).
        reference: required end: p (3), s3 (3), v (3), w (3), shape (12,).
        lines: rows of centre, direction, radius, half length, shape (lines, 8).
        run_weights: thrust, body rate, ramp, body rate between nodes, shape (4,); see `stage_functions`.
        end_weights: horizontal position, height, tilt, velocity, body rate, thrust, shape (6,).
        perception_weights: reprojection, cheirality, segment visibility of every node, shape (N, 3).
        duration: bounds of T [s]. [P:eq14c]
        height_min: z_min with its margin [m]. [P:eq14e]
        thrust: bounds of a rotor's thrust [N]. [P:eq14f]
        body_rate: bound of |w_WB_B| [rad/s].
        end_tolerance: tolerances of the values that vanish at the last node, one each, see `solving.end_tolerances`.
        clearance: least (d^2 - 1) / (d^2 + 1) of the scaled distance d to a line at each node but the first, see
            `stage_functions`, shape (N,). [P:eq14j]
        states, inputs: initial guess, shapes (N + 1, 18) and (N, 4), inputs in [-1, 1].
        defects: correction of the integrator's result at the end of every interval, shape (N, 18); see `defects_of`.
    """

    start: np.ndarray
    reference: np.ndarray
    lines: np.ndarray
    run_weights: np.ndarray
    end_weights: np.ndarray
    perception_weights: np.ndarray
    duration: tuple[float, float]
    height_min: float
    thrust: tuple[float, float]
    body_rate: float
    end_tolerance: np.ndarray
    clearance: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    defects: np.ndarray


@dataclass(frozen=True)
class Solution:
    """Result of a solve.

    Attributes:
        states, inputs: shapes (N + 1, 18) and (N, 4).
        converged: the solver reports a local optimum.
        status: status text of the solver.
        cost: value of [P:eq14a].
        iterations: of the interior-point method.
        time: wall-clock time of the solve [s].
        cpu_time: CPU time of this process in the solve [s].
    """

    states: np.ndarray
    inputs: np.ndarray
    converged: bool
    status: str
    cost: float
    iterations: int
    time: float
    cpu_time: float

    @property
    def duration(self) -> float:
        """T [s]."""
        return float(self.states[0, STATES])


@dataclass
class Problem:
    """A solver of one structure, built from stage functions once and solved many times. [defines P:eq14]"""

    structure: Structure
    stages: StageFunctions
    tolerance: float = 1e-6
    barrier: float | None = None  # first barrier parameter; a small one keeps to a good guess
    push: float = 1e-2  # how far a guess is pushed off its active bounds
    max_iterations: int = 300
    gauss_newton: bool = False  # perception costs without the curvature of their residuals: quick from afar, slow at the end
    _solver: ca.Function = field(init=False, repr=False)
    _equality: np.ndarray = field(init=False, repr=False)
    _clearances: np.ndarray = field(init=False, repr=False)
    _end: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        N, count, f = self.structure.intervals, self.structure.lines, self.stages.functions
        x = ca.MX.sym("x", N * STRIDE + STAGE_STATES)
        sizes = [LINE_SIZE] * count + [1, STATES, REFERENCE, RUN_WEIGHTS, END_WEIGHTS, PERCEPTION_WEIGHTS * N, STAGE_STATES * N]
        p = ca.MX.sym("p", sum(sizes))
        *lines, body_rate, start, reference, run, end, perception, defects = ca.vertsplit(p, np.cumsum([0, *sizes]).tolist())
        parameters = Parameters(lines, body_rate, reference, run, end, ca.reshape(perception, PERCEPTION_WEIGHTS, N))
        X, U = split(x, N)

        cost = ca.sum2(f["run"].map(N)(X[:, :N], U, 1.0 / N, run)) + f["end"](X[:, N], reference, end)
        if self.structure.perception:
            cost += ca.sum2(f["perception"].map(N)(X[:, :N], lines[0], parameters.perception))
        gaps = X[:, 1:] - f["step"].map(N)(X[:, :N], U, 1.0 / N) - ca.reshape(defects, STAGE_STATES, N)
        path = path_functions(parameters)
        path_values = ca.vertcat(*[f[name].map(N)(X[:, 1:], parameter) for name, parameter in path])
        between = f["body_rate_between"].map(N)(X[:, :N], U, 1.0 / N, body_rate)
        remaining = ca.vec(ca.vertcat(gaps[:, 1:], path_values[:, :-1], between[1:]))
        end_name = self.structure.end
        g = ca.vertcat(gaps[:, 0], X[:STATES, 0] - start, between[0], remaining, path_values[:, -1],
                       *([f[end_name](X[:, N], reference)] if end_name else []))
        at = constraint_rows(N, len(path), end_size(self.stages, end_name))
        self._clearances = (at.inner[:, None] + np.arange(count)).ravel()
        self._equality = np.ones(at.count, bool)
        self._equality[self._clearances] = self._equality[at.inner + count] = self._equality[at.between] = False
        self._equality[at.end:] = False
        self._end = at.end

        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.shape[0])
        gradient, H = hessian(self.stages, x, parameters, N, lam_f, lam_g, self.structure.perception, end_name,
                              self.gauss_newton)
        jac_g = ca.Function("nlp_jac_g", [x, p], [g, jacobian(self.stages, x, parameters, N, end_name)], ["x", "p"], ["g", "jac_g_x"])
        if self.structure.solver == "fatrop":
            hess_l = ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [gradient, H], ["x", "p", "lam_f", "lam_g"],
                                 ["grad_gamma_x", "hess_gamma_x_x"])
            options: dict[str, Any] = {"structure_detection": "auto", "equality": self._equality.tolist(), "fatrop.print_level": 0}
        else:
            hess_l = ca.Function("nlp_hess_l", [x, p, lam_f, lam_g], [ca.triu(H)], ["x", "p", "lam_f", "lam_g"],
                                 ["triu_hess_gamma_x_x"])
            options = {"ipopt.print_level": 0, "ipopt.sb": "yes"}
        name = self.structure.solver
        options |= {"print_time": False, "expand": False, "error_on_fail": False, "calc_lam_p": False,
                    "cache": {"nlp_jac_g": jac_g, "nlp_hess_l": hess_l},
                    f"{name}.tol": self.tolerance, f"{name}.max_iter": self.max_iterations, **self._start_options(name)}
        problem: Any = {"x": x, "f": cost, "g": g, "p": p}
        self._solver = ca.nlpsol("powerline", name, problem, options)

    def _start_options(self, name: str) -> dict[str, float]:
        """Solver options to start from a good guess: a small barrier, and a small push off its active bounds."""
        if self.barrier is None:
            return {}
        return {f"{name}.mu_init": self.barrier, f"{name}.bound_push": self.push, f"{name}.bound_frac": self.push}

    def _bounds(self, data: ProblemData) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the variables; T is bounded at the first node only, as it is equal at all nodes."""
        N = self.structure.intervals
        low, high = np.full((N + 1, STRIDE), -_UNBOUNDED), np.full((N + 1, STRIDE), _UNBOUNDED)
        low[1:, 2] = data.height_min
        low[1:, 13:17], high[1:, 13:17] = data.thrust
        low[0, STATES], high[0, STATES] = data.duration
        low[:, STAGE_STATES:], high[:, STAGE_STATES:] = -1.0, 1.0
        return low.ravel()[:-INPUTS], high.ravel()[:-INPUTS]

    def defects_of(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Error of the problem's integrator along a trajectory: a `FINER` times finer step minus its own, shape (N, 18).

        Two RK4 steps per interval drift by millimetres until the end. The error hardly changes between neighbouring
        trajectories: added as a constant in the next solve, it is compensated there.
        """
        step, N = self.stages.functions["step"], self.structure.intervals
        coarse = step(states[:-1].T, inputs.T, 1.0 / N)
        fine = states[:-1].T
        for _ in range(FINER):
            fine = step(fine, inputs.T, 1.0 / (FINER * N))
        return np.array(fine - coarse).T

    def solve(self, data: ProblemData) -> Solution:
        """Solve one problem from its initial guess."""
        N = self.structure.intervals
        guess = np.concatenate([data.states, np.vstack([data.inputs, np.zeros(INPUTS)])], axis=1).ravel()[:-INPUTS]
        parameters = np.concatenate([data.lines.ravel(), [data.body_rate], data.start, data.reference, data.run_weights,
                                     data.end_weights, data.perception_weights.ravel(),
                                     data.defects.ravel()])
        low, high = self._bounds(data)
        lower = np.zeros(len(self._equality))
        lower[self._clearances] = np.repeat(data.clearance, self.structure.lines)
        upper = np.where(self._equality, 0.0, _UNBOUNDED)
        lower[self._end:], upper[self._end:] = -data.end_tolerance, data.end_tolerance
        begin, cpu = time.perf_counter(), time.process_time()
        result = self._solver(x0=guess, p=parameters, lbx=low, ubx=high,
                              lbg=lower, ubg=upper)
        elapsed, cpu = time.perf_counter() - begin, time.process_time() - cpu
        statistics = self._solver.stats()
        found = np.concatenate([np.array(result["x"]).ravel(), np.zeros(INPUTS)]).reshape(N + 1, STRIDE)
        return Solution(found[:, :STAGE_STATES], found[:-1, STAGE_STATES:], bool(statistics["success"]),
                        str(statistics.get("return_status", statistics.get("unified_return_status", ""))),
                        float(result["f"]), int(statistics["iter_count"]), elapsed, cpu)
