"""The NLP's stage functions as CasADi expressions: dynamics, running, perception and end costs, clearance. [P:eq14-15]

Each is one small function of one stage. The solver's per-stage structure lets them be compiled once and called N times,
which makes the compile short (the whole NLP unrolled takes seven times as long) and the solve fast. Their derivatives are
generated here as well: assembled by `derivatives`, they take a fifth of the time of CasADi's own chain rule through N
compiled calls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from perch_core import lines, rotor_model
from perch_core.arrays import quaternion, vector3
from perch_core.camera_mount import CameraMount
from perch_core.components import Scalar, Vector, components, dot, matrix_of, rotate_back
from perch_core.rotor_model import INPUTS, P, Q, STATES, THRUST, V, W, RotorModel
from perch_core.so3 import quat_from_matrix

STAGE_STATES = STATES + 1  # the duration T is a constant state
SUB_STEPS = 2  # one RK4 step per T/30 drifts up to 22 mm when re-integrated; two stay below 0.7 mm
LINE_SIZE = 8  # centre (3), direction (3), radius, half length
SEGMENT_AIM = 0.5  # share of the segment's half length within which the soft constraint keeps the centred point
POLE = 1e-18  # of n_x^2 + n_y^2 of the line in [P:eq9], below which it has no value [m^2]
RUN_WEIGHTS, PERCEPTION_WEIGHTS, END_WEIGHTS, REFERENCE = 4, 3, 6, 12


@dataclass(frozen=True)
class StageModel:
    """Constants of the stage functions.

    Attributes:
        rotor: the 17-state model.
        thrust_rate_max: scale of the inputs: u = thrust_rate_max * mu with mu in [-1, 1] [N/s].
        body_radii: ellipsoid that contains the vehicle [m].
        p_BC, q_BC: place of the camera on the body [m, xyzw].
    """

    rotor: RotorModel
    thrust_rate_max: float
    body_radii: tuple[float, float, float]
    p_BC: tuple[float, float, float]
    q_BC: tuple[float, float, float, float]

    @classmethod
    def of(cls, rotor: RotorModel, thrust_rate_max: float, body_radii: Vector, camera: CameraMount) -> StageModel:
        """The stage model of a vehicle's parts."""
        return cls(rotor, float(thrust_rate_max), vector3(body_radii), vector3(camera.p_BC), quaternion(quat_from_matrix(camera.R_BC)))


def _step(model: StageModel, x: Vector, u: Vector, unit_step: Scalar) -> Vector:
    """Next node: [P:eq14d], the dynamics scaled by the duration T and stepped by 1/N of a unit horizon."""
    interval = x[STATES] * unit_step
    rates = tuple(model.thrust_rate_max * value for value in u)
    state = x[:STATES]
    for _ in range(SUB_STEPS):
        state = rotor_model.rk4(model.rotor, state, rates, interval / SUB_STEPS)
    return (*state, x[STATES])


def _halfway(model: StageModel, x: Vector, u: Vector, unit_step: Scalar) -> Vector:
    """State in the middle of the interval that starts at a node."""
    rates = tuple(model.thrust_rate_max * value for value in u)
    return rotor_model.rk4(model.rotor, x[:STATES], rates, x[STATES] * unit_step / 2)


def _run(model: StageModel, x: Vector, u: Vector, unit_step: Scalar, weights: Vector) -> Scalar:
    """Running cost of thrust and body rate. [P:eq15]

    weights: thrust, body rate, ramp, body rate in the middle of the interval. The paper weights the body rate at the nodes
    only; a light body then oscillates between them at no cost. The impulse is N times the paper's gamma T / N + u T^2 / (2 N^2),
    that is gamma T + ramp mu T^2 with ramp = thrust_rate_max / (2 N); the authors' code has ramp = 1/2 instead.
    """
    T = x[STATES]
    impulse = tuple(gamma * T + weights[2] * mu * T * T for gamma, mu in zip(x[THRUST], u))
    half = _halfway(model, x, u, unit_step)[W]
    return weights[0] * dot(impulse, impulse) + weights[1] * dot(x[W], x[W]) + weights[3] * dot(half, half)


def _violation(h: Scalar) -> Scalar:
    """Violation of a soft constraint h > 0; its square equals the cost of a slack with quadratic cost."""
    return ca.fmax(0, -h)


def _off_pole(n_I: Vector) -> Vector:
    """`n_I`, with another value at the pole of [P:eq9, P:eq13], where the line is beside the camera, in the plane of its x and y axes.

    Where a start has its camera exactly below or above the line, the solver would get NaN at the first node, and fatrop not return.
    As the start is fixed, the value there does not matter.
    """
    return ca.if_else(n_I[0] * n_I[0] + n_I[1] * n_I[1] < POLE, 1.0, n_I[0]), n_I[1], n_I[2]


def _perception_residuals(model: StageModel, x: Vector, line: Vector) -> Vector:
    """Residuals of the perception cost: reprojection, cheirality, segment visibility. [uses P:eq9, P:eq12, P:eq13]

    The authors' arctan of [P:eq13] has zero slope where the camera axis is parallel to the line, so that a solver started
    there never turns it. The angle of (d, s d) of `lines.segment_place` is equivalent and decreases linearly as the camera
    turns. As the constraint is soft, it aims well inside s^2 < 1, see SEGMENT_AIM.
    """
    o_C, l_C = lines.line_in_camera(x[P], x[Q], line[0:3], line[3:6], model.p_BC, model.q_BC)
    n_I, l_I = lines.image_line(o_C, l_C)
    n_I = _off_pole(n_I)
    along, in_front = lines.segment_place(n_I, l_I, o_C, line[7])
    beside = ca.fabs(ca.atan2(along, SEGMENT_AIM * in_front)) - np.pi / 4
    return lines.reprojection_error(n_I), _violation(in_front), _violation(-beside)


def _perception(model: StageModel, x: Vector, line: Vector, weights: Vector) -> Scalar:
    """Perception cost and soft constraints of the target line. [P:eq9, P:eq12, P:eq13, P:eq14h, P:eq14i]"""
    return sum(weight * value * value for weight, value in zip(weights, _perception_residuals(model, x, line), strict=True))


def _end(model: StageModel, x: Vector, reference: Vector, weights: Vector) -> Scalar:
    """Terminal cost: position, tilt, velocity, body rate, rotor thrust. [P:eq15]

    The orientation error with free yaw is the direction of thrust, R e3 - s3: unlike the paper's Euler angles it has no
    singular attitude. The thrust term (zero in the paper) lets a recovery end in hover.

    Args:
        model: constants.
        x: last node.
        reference: p (3), s3 (3), v (3), w (3).
        weights: horizontal position, height, tilt, velocity, body rate, rotor thrust.
    """
    def squared_error(values: Vector, first: int) -> Scalar:
        error = tuple(value - reference[first + i] for i, value in enumerate(values))
        return dot(error, error)

    b3_W = tuple(row[2] for row in matrix_of(x[Q]))
    hover_error = tuple(gamma - model.rotor.hover for gamma in x[THRUST])
    height = x[2] - reference[2]
    return (weights[0] * squared_error(x[0:2], 0) + weights[1] * height * height + weights[2] * squared_error(b3_W, 3)
            + weights[3] * squared_error(x[V], 6) + weights[4] * squared_error(x[W], 9) + weights[5] * dot(hover_error, hover_error))


def _tilt_error(x: Vector, reference: Vector) -> Vector:
    """First two components of s3 in the body frame, which vanish where b3 is s3 (or -s3)."""
    return rotate_back(x[Q], reference[3:6])[:2]


def _perched(model: StageModel, x: Vector, reference: Vector) -> Vector:
    """Values that vanish at the end of a perch: the errors of `_end_errors`, and the moment, for a gripper to close; 14 values."""
    return (*_end_errors(x, reference), *(dot(row, x[THRUST]) for row in model.rotor.torque))


def _end_errors(x: Vector, reference: Vector) -> Vector:
    """Errors of position, direction of b3, velocity and body rate at the end, 11 values."""
    moving = tuple(value - goal for value, goal in zip((*x[V], *x[W]), reference[6:12], strict=True))
    return (*(value - goal for value, goal in zip(x[P], reference[:3], strict=True)), *_tilt_error(x, reference), *moving)


def _hovering(model: StageModel, x: Vector, reference: Vector) -> Vector:
    """Values that vanish at the end of a recovery, at any position: as `_end_errors`, rotor thrusts for the position; 12 values."""
    return (*_end_errors(x, reference)[3:], *(gamma - model.rotor.hover for gamma in x[THRUST]))


def _clearance(model: StageModel, x: Vector, line: Vector) -> Scalar:
    """[P:eq7] divided by |o x l|^2 + |l|^2 + k: (d^2 - 1) / (d^2 + 1) of the scaled distance d.

    The sign is the paper's, but the value is dimensionless, between -1 and 1, and its slope at contact is 1, so that
    a solver's tolerance and a margin have the same meaning everywhere.
    """
    radii = tuple(r + line[6] for r in model.body_radii)
    h = lines.segment_clearance(x[P], x[Q], line[0:3], line[3:6], line[7], line[6], model.body_radii)
    _, l = lines.scaled_line(x[P], x[Q], line[0:3], line[3:6], radii)
    return h / (h + 2 * dot(l, l))


def _body_rate(x: Vector, limit: Scalar) -> Scalar:
    """1 - |w|^2 / limit^2: positive where the body rate is below its limit, about any axis."""
    return 1 - dot(x[W], x[W]) / (limit * limit)


def _body_rate_between(model: StageModel, x: Vector, u: Vector, unit_step: Scalar, limit: Scalar) -> Scalar:
    """`_body_rate` in the middle of the interval that starts at a node.

    A light body may reach its greatest rate between two nodes and be at rest at both: its torque permits 5000 rad/s^3.
    Body rate and thrusts do not depend on the rest of the state, so that this costs little.
    """
    return _body_rate(_halfway(model, x, u, unit_step), limit)


@dataclass(frozen=True)
class StageFunctions:
    """The functions of one stage, their derivatives as flat vectors of nonzeros, and the sparsity of these.

    Attributes:
        functions: by name. `step(x, u, 1/N) -> x_next`; `run(x, u, 1/N, weights)`, `perception(x, line, weights)`,
            `end(x, reference, weights)` -> cost; `clearance(x, line)`, `body_rate(x, limit)`, `body_rate_between(x, u, 1/N, limit)`
            -> constraint; `perched(x, reference)`, `hovering(x, reference)` -> values that vanish at the end,
            with x of 18 values (17 states, T) and u of 4 in [-1, 1]. `<name>_jac(...)` -> nonzeros of the
            Jacobian; `<name>_hess(..., lam)` -> gradient of lam . f and then the nonzeros
            of the upper triangle of its Hessian. Derivatives are with respect to x, or (x, u).
            `perception_gauss_newton` is `perception_hess` without the curvature of the residuals: positive semidefinite.
        jacobian, hessian: sparsity of these nonzeros by base name; the Hessian's is an upper triangle.
    """

    functions: dict[str, ca.Function]
    jacobian: dict[str, ca.Sparsity]
    hessian: dict[str, ca.Sparsity]

    def with_functions(self, functions: dict[str, ca.Function]) -> StageFunctions:
        """Return a copy with other bodies, such as compiled ones, under the same names."""
        return StageFunctions(functions, self.jacobian, self.hessian)


def stage_functions(model: StageModel) -> StageFunctions:
    """Build the stage functions and their derivatives as expressions; `run`, `perception` and `end` are the cost. [defines P:eq15]"""
    x, u = ca.SX.sym("x", STAGE_STATES), ca.SX.sym("u", INPUTS)
    line, reference = ca.SX.sym("line", LINE_SIZE), ca.SX.sym("reference", REFERENCE)
    unit_step, limit = ca.SX.sym("unit_step"), ca.SX.sym("limit")
    run, perception, end = (ca.SX.sym(name, size) for name, size in
                     (("run", RUN_WEIGHTS), ("perception", PERCEPTION_WEIGHTS), ("end", END_WEIGHTS)))
    xs, us, ls, rs = map(components, (x, u, line, reference))
    rw, pw, ew = map(components, (run, perception, end))
    expressions = {
        "step": ([x, u], [unit_step], ca.vertcat(*_step(model, xs, us, unit_step))),
        "run": ([x, u], [unit_step, run], _run(model, xs, us, unit_step, rw)),
        "perception": ([x], [line, perception], _perception(model, xs, ls, pw)),
        "end": ([x], [reference, end], _end(model, xs, rs, ew)),
        "perched": ([x], [reference], ca.vertcat(*_perched(model, xs, rs))),
        "hovering": ([x], [reference], ca.vertcat(*_hovering(model, xs, rs))),
        "clearance": ([x], [line], _clearance(model, xs, ls)),
        "body_rate": ([x], [limit], _body_rate(xs, limit)),
        "body_rate_between": ([x, u], [unit_step, limit], _body_rate_between(model, xs, us, unit_step, limit)),
    }
    functions, jacobian, hessian = {}, {}, {}
    for name, (variables, parameters, value) in expressions.items():
        z, inputs = ca.vertcat(*variables), variables + parameters
        lam = ca.SX.sym("lam", value.shape[0])
        value, = ca.cse([value])
        J, = ca.cse([ca.jacobian(value, z)])
        gradient, = ca.cse([ca.gradient(ca.dot(lam, value), z)])
        H = ca.triu(ca.jacobian(gradient, z))  # without the lower triangle: three quarters of the operations of `ca.hessian`
        differentiable = [i < len(variables) for i in range(len(inputs))]
        functions[name] = ca.Function(name, inputs, [value], {"is_diff_in": differentiable})
        functions[f"{name}_jac"] = ca.Function(f"{name}_jac", inputs, [_nonzeros(J)])
        functions[f"{name}_hess"] = ca.Function(f"{name}_hess", [*inputs, lam],
                                                ca.cse([ca.vertcat(ca.densify(gradient), _nonzeros(H))]))
        jacobian[name], hessian[name] = J.sparsity(), H.sparsity()
    lam, residuals = ca.SX.sym("lam"), ca.vertcat(*_perception_residuals(model, xs, ls))
    J = ca.jacobian(residuals, x)
    gradient, H = (2 * lam * J.T @ (ca.diag(perception) @ right) for right in (residuals, J))
    functions["perception_gauss_newton"] = ca.Function("perception_gauss_newton", [x, line, perception, lam], [
        ca.cse(ca.vertcat(ca.densify(gradient), _nonzeros(ca.project(ca.triu(H), hessian["perception"]))))])
    return StageFunctions(functions, jacobian, hessian)


def _nonzeros(matrix: ca.SX) -> ca.SX:
    entries: Any = matrix.nonzeros()
    stacked: ca.SX = ca.vertcat(*entries)
    return stacked


def line_parameters(segment: lines.Segment) -> np.ndarray:
    """Parameters of a segment for the stage functions, shape (8,)."""
    return np.array([*segment.centre, *segment.direction, segment.radius, segment.half_length])
