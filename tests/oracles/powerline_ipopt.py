"""Is there a perch? Direct collocation and IPOPT from several guesses, written from the paper: the oracle for refusals. [P:eq14]

It shares with the planner the vehicle's numbers and what counts as a plan: the thrust rates that it finds are flown at 1 ms
and certified as the planner's are. Its dynamics, transcription (Gauss-Legendre collocation of order six), distance to a
segment (its true nearest point), end conditions, cost and guesses are its own. A solve takes seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from perch_core.rotor_model import RotorModel
from perch_core.values import Certificate
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline.certificate import certify, certify_end
from perch_planner.powerline.flight import simulate
from perch_planner.powerline.formulation import DEFAULT
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

INTERVALS = 40
DEGREE = 3     # of the collocation; its second point is the middle of the interval
ROOM = 0.02    # of the scaled distance to a wire, and of other limits, at nodes and in the middle between them
POSE = 13      # p, q (xyzw), v, w; the four thrusts are linear within an interval
DURATIONS = (1.0, 0.7, 1.5)  # of the guesses, over 0.8 s and 0.3 s per metre
ASIDE = ((0.0, 0.0), (0.0, -0.8), (0.0, 0.8), (0.8, 0.0), (-0.8, 0.0))  # of the guesses' middle: along the wire, up [m]
SECONDS = 10.0  # of processor time, at most, from each guess


@dataclass(frozen=True)
class Found:
    """A perch that the oracle found.

    Attributes:
        duration: [s].
        rates: thrust rates of each interval [N/s], shape (INTERVALS, 4).
        bounds: certificates of its flight at 1 ms, as of a plan; all of them hold.
        guesses: number of guesses that it took.
    """

    duration: float
    rates: np.ndarray
    bounds: tuple[Certificate, ...]
    guesses: int


def _turned(q: Any) -> Any:
    """Rotation matrix of a quaternion xyzw, by Rodrigues' formula."""
    axis = ca.skew(q[:3])
    return ca.DM.eye(3) + 2 * q[3] * axis + 2 * axis @ axis


@dataclass
class Oracle:
    """Looks for perches of one vehicle."""

    vehicle: Vehicle
    settings: PowerlineSettings = field(default_factory=PowerlineSettings)

    def perch(self, request: PowerlineRequest) -> Found | None:
        """The first perch that is found within all limits; None: none from any guess."""
        assert request.perch is not None
        solver, lows, highs, thrust_max = self._program(request)
        for number, guess in enumerate(self._guesses(request), 1):
            try:
                answer = solver(x0=guess, lbx=lows[0], ubx=highs[0], lbg=lows[1], ubg=highs[1])
            except RuntimeError:  # IPOPT met an invalid number
                continue
            duration, rates = self._inputs(np.array(answer["x"]).ravel())
            times, states, dense = simulate(RotorModel.of(self.vehicle), request.start, rates, duration)
            bounds = (*certify(self.vehicle, times, states, dense, request.lines, self.settings.height_min, thrust_max),
                      *certify_end(times, states, request.perch, *DEFAULT.accuracy))
            if all(bound.holds for bound in bounds):
                return Found(duration, rates, bounds, number)
        return None

    def _flow(self) -> ca.Function:
        """Rates of p, q, v, w under rotor thrusts. [P:eq1, P:eq2]"""
        x, gamma = ca.SX.sym("x", POSE), ca.SX.sym("gamma", 4)
        q, v, w = x[3:7], x[7:10], x[10:13]
        wrench, J = ca.DM(self.vehicle.allocation) @ gamma, ca.DM(self.vehicle.inertia_matrix)
        a = _turned(q)[:, 2] * wrench[0] / self.vehicle.mass - ca.DM([0, 0, GRAVITY])
        dq = 0.5 * ca.vertcat(q[3] * w + ca.cross(q[:3], w), -ca.dot(q[:3], w))
        return ca.Function("flow", [x, gamma], [ca.vertcat(v, dq, a, ca.solve(J, wrench[1:] - ca.cross(w, J @ w)))])

    def _interval(self) -> ca.Function:
        """Start (17), inner points (13 x DEGREE), thrust rates, T -> residuals of the collocation, and the next 17."""
        flow, roots = self._flow(), ca.collocation_points(DEGREE, "legendre")
        C, D, B = ca.collocation_coeff(roots)
        x, inner, u, T = ca.SX.sym("x", POSE + 4), ca.SX.sym("inner", POSE, DEGREE), ca.SX.sym("u", 4), ca.SX.sym("T")
        h, points = T / INTERVALS, ca.horzcat(x[:POSE], inner)
        slopes = ca.horzcat(*[flow(inner[:, j], x[POSE:] + roots[j] * h * u) for j in range(DEGREE)])
        return ca.Function("interval", [x, inner, u, T], [ca.vec(points @ C - h * slopes), ca.vertcat(points @ D, x[POSE:] + h * u)])

    def _inside(self, request: PowerlineRequest) -> ca.Function:
        """What must not be negative on the way: scaled distances to all segments less 1, and a share of the body rate. [P:eq14j]"""
        x, radii, apart = ca.SX.sym("x", POSE), np.array(self.vehicle.body_radii), []
        for line in request.lines:
            scaled = ca.diag(1 / (radii + line.radius)) @ _turned(x[3:7]).T
            o, l = scaled @ (ca.DM(line.centre) - x[:3]), scaled @ ca.DM(line.direction)
            at = ca.fmax(-line.half_length, ca.fmin(line.half_length, -ca.dot(o, l) / ca.dot(l, l)))
            apart.append(ca.sumsqr(o + at * l) - 1)
        return ca.Function("inside", [x], [ca.vertcat(*apart, 1 - ca.sumsqr(x[10:13]) / self.vehicle.body_rate_max**2)])

    def _program(self, request: PowerlineRequest) -> tuple[ca.Function, list[np.ndarray], list[np.ndarray], float]:
        """The solver, lower and upper bounds of its variables and constraints, and the greatest thrust."""
        s, pose = self.settings, request.perch
        thrust_max = max(s.thrust_share * self.vehicle.thrust_max, float(request.start[POSE:].max()))
        X, Z = ca.MX.sym("X", POSE + 4, INTERVALS + 1), ca.MX.sym("Z", POSE * DEGREE, INTERVALS)
        U, T = ca.MX.sym("U", 4, INTERVALS), ca.MX.sym("T")
        inner = ca.reshape(Z, POSE, DEGREE * INTERVALS)
        residuals, after = self._interval().map(INTERVALS)(X[:, :-1], inner, U, ca.repmat(T, 1, INTERVALS))
        inside, last = self._inside(request), X[:, -1]
        limits = ca.horzcat(inside.map(INTERVALS)(X[:POSE, 1:]), inside.map(INTERVALS)(inner[:, 1::DEGREE]))
        across = ca.DM(np.linalg.svd(pose.s3_W[None])[2][1:])  # two directions square to s3
        b3 = _turned(last[3:7])[:, 2]
        end = ca.vertcat(last[:3] - pose.p_WB, last[7:10] - pose.v_W, across @ b3)
        g = [ca.vec(residuals), ca.vec(X[:, 1:] - after), X[:, 0] - request.start, end, ca.vec(limits), ca.dot(b3, ca.DM(pose.s3_W))]
        equalities = sum(part.numel() for part in g[:4])
        cost = T + 0.01 * T / INTERVALS * ca.sumsqr(X[10:13, :]) + 1e-5 * ca.sumsqr(U)
        variables = ca.vertcat(ca.vec(X), ca.vec(Z), ca.vec(U), T)
        options = {"print_time": False, "expand": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 400,
                   "ipopt.max_cpu_time": SECONDS, "ipopt.tol": 1e-3, "ipopt.constr_viol_tol": 1e-7,
                   # A plan need not be the best one.
                   "ipopt.acceptable_tol": 1e6, "ipopt.acceptable_dual_inf_tol": 1e10, "ipopt.acceptable_compl_inf_tol": 1.0,
                   "ipopt.acceptable_constr_viol_tol": 1e-6, "ipopt.acceptable_iter": 3}
        problem: Any = {"x": variables, "f": cost, "g": ca.vertcat(*g)}
        solver = ca.nlpsol("oracle", "ipopt", problem, options)

        low = np.full((INTERVALS + 1, POSE + 4), -np.inf)
        high = -low
        low[1:, 3:7], high[1:, 3:7] = -1.01, 1.01  # wide bounds keep IPOPT's iterates near what flies
        low[1:, 7:10], high[1:, 7:10] = -15.0, 15.0
        low[1:, 10:POSE], high[1:, 10:POSE] = -self.vehicle.body_rate_max, self.vehicle.body_rate_max
        low[1:, 2] = s.height_min + min(ROOM, 0.5 * max(0.0, min(request.start[2], pose.p_WB[2]) - s.height_min))
        low[1:, POSE:], high[1:, POSE:] = self.vehicle.thrust_min, thrust_max
        free, rate = np.full(Z.numel(), np.inf), np.full(U.numel(), self.vehicle.thrust_rate_max)
        ends = np.array(inside(ca.DM([*pose.p_WB, *pose.q_WB, 0, 0, 0, 0, 0, 0]))).ravel()
        room = np.minimum(ROOM, 0.5 * np.maximum(ends, 0.0))  # a pose may be nearer to a wire than the room
        least = np.concatenate([np.zeros(equalities), np.tile(room, 2 * INTERVALS), [0.9]])
        most = np.concatenate([np.zeros(equalities), np.full(limits.numel() + 1, np.inf)])
        return (solver, [np.concatenate([low.ravel(), -free, -rate, [s.duration[0]]]), least],
                [np.concatenate([high.ravel(), free, rate, [s.duration[1]]]), most], thrust_max)

    @staticmethod
    def _inputs(values: np.ndarray) -> tuple[float, np.ndarray]:
        return float(values[-1]), values[-1 - 4 * INTERVALS:-1].reshape(INTERVALS, 4)

    def _guesses(self, request: PowerlineRequest) -> Iterator[np.ndarray]:
        """Paths bent to several sides, turning over late, forwards or backwards about the wire, in several durations."""
        pose, target = request.perch, request.target()
        fine = np.linspace(0.0, 1.0, INTERVALS * (DEGREE + 1) + 1)
        usual = 0.8 + 0.3 * float(np.linalg.norm(pose.p_WB - request.start[:3]))
        for share, (along, up), sign in product(DURATIONS, ASIDE, (1.0, -1.0)):
            T = share * usual
            middle = 0.5 * (request.start[:3] + pose.p_WB) + along * target.direction + [0, 0, up]
            smooth = fine**2 * (3 - 2 * fine)
            way = pose.p_WB - request.start[:3]
            p = request.start[:3] + smooth[:, None] * way + (4 * smooth * (1 - smooth))[:, None] * (middle - 0.5 * (request.start[:3] + pose.p_WB))
            p[:, 2] = np.maximum(p[:, 2], self.settings.height_min + 0.1)
            q = _attitudes(request.start[3:7], pose.s3_W, np.clip(2 * fine - 1, 0, 1), sign)
            v = np.gradient(p, fine * T, axis=0)
            states = np.column_stack([p, q, v, np.zeros((len(fine), 3)), np.full((len(fine), 4), self.vehicle.hover_thrust / 4)])
            nodes, points = states[::DEGREE + 1].copy(), np.delete(states, np.s_[::DEGREE + 1], axis=0)[:, :POSE]
            nodes[0] = request.start
            yield np.concatenate([nodes.ravel(), points.ravel(), np.zeros(4 * INTERVALS), [T]])


def _attitudes(start: np.ndarray, s3_W: np.ndarray, share: np.ndarray, sign: float) -> np.ndarray:
    """Quaternions that turn b3 from where it is at the start to s3, the short way about their normal or the long way, shape (n, 4)."""
    b3 = np.array(_turned(ca.DM(start)))[:, 2]
    normal = np.cross(b3, s3_W)
    if np.linalg.norm(normal) < 1e-6:
        normal = np.cross(b3, [0.6, 0.8, 0.0])
    angle = np.arctan2(np.linalg.norm(np.cross(b3, s3_W)), b3 @ s3_W)
    angle = angle if sign > 0 else angle - 2 * np.pi
    half = 0.5 * angle * share**2 * (3 - 2 * share)
    a = np.column_stack([np.sin(half)[:, None] * normal / np.linalg.norm(normal), np.cos(half)])
    vector = a[:, 3:] * start[:3] + start[3] * a[:, :3] + np.cross(a[:, :3], start[:3])
    return np.column_stack([vector, a[:, 3] * start[3] - a[:, :3] @ start[:3]])
