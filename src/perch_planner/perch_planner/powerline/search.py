"""Search for a perch or recovery: solve, simulate at 1 ms, check, and solve again where the check fails. [P:V-B, P:Fig.3]"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment, scaled_clearance
from perch_core.rotor_model import P, Q, STATES, THRUST
from perch_core.so3 import quat_from_matrix
from perch_core.values import Certificate
from perch_core.vehicle import Vehicle
from perch_planner.powerline import guess
from perch_planner.powerline.certificate import certify, certify_end
from perch_planner.powerline.flight import simulate
from perch_planner.powerline.formulation import Formulation, Weights
from perch_planner.powerline.nlp import ProblemData, Solution, Structure
from perch_planner.powerline.plan import Manoeuvre
from perch_planner.powerline.request import E3, PerchPose, PowerlineRequest
from perch_planner.powerline.settings import Margins, PowerlineSettings
from perch_planner.powerline.solving import Solver, end_tolerances, end_weights, perception_weights, run_weights
from perch_planner.powerline.stage_functions import line_parameters

LINES_MAX = 6  # segments in the problem: the target and the nearest others; the check takes all
ATTEMPTS = 6  # solves of one manoeuvre: with a larger N, or from another guess and with another solver
REFINEMENTS = 2  # solves with the same N for the end alone: each leaves a hundredth of its error
MARGIN_DECAY = 0.75  # of `leaving` and `approaching`, after each solve that finds no plan to the end: they may be reduced, unlike the limits
RADIUS_REDUCTION = 0.02  # the paper's, for a recovery that starts at the wire: part of a wire's radius is safety [m]


@dataclass(frozen=True)
class Task:
    """One manoeuvre to solve: a perch or a recovery.

    Attributes:
        name: for messages.
        request: start, all lines for the check, whether the target is kept in view, solver and deadline.
        goal: end pose and velocity.
        lines: lines in the problem, the target first.
        weights: of the costs.
        end: name of the end condition, see `nlp.Structure`.
        duration: bounds of T [s].
        margins: distances of the nodes from the limits.
        guess: attempt and N -> states and inputs.
        accuracy: position [m], tilt [deg], speed [m/s] at the end; inf: any.
        leaving: clearance margin from a quarter of the time on, reduced where no plan is found; 0: that of `margins`.
        approaching: clearance margin until a tenth of the time before the end, reduced likewise; 0: that of `margins`.
        end_clearance_max: upper bound of the clearance margin at the end, from the goal pose; 1: none.
        radius_reduction: taken off the wires' radius [m].
    """

    name: str
    request: PowerlineRequest
    goal: PerchPose
    lines: tuple[Segment, ...]
    weights: Weights
    end: str
    duration: tuple[float, float]
    margins: Margins
    guess: Callable[[int, int], tuple[np.ndarray, np.ndarray]]
    accuracy: tuple[float, float, float]
    leaving: float = 0.0
    approaching: float = 0.0
    end_clearance_max: float = 1.0
    radius_reduction: float = 0.0


class NotConverged(PlanningRefusal):
    """Raised when no manoeuvre was found and the limit that prevents it is unknown.

    Attributes:
        attempt_time: of the first attempt [s]; a trial without a limit, with half as many iterations, takes less.
    """

    def __init__(self, name: str, tried: str, attempt_time: float) -> None:
        super().__init__("infeasible", name, -1.0, f"no {name} was found: the solver did not converge from several guesses ({tried}); "
                                                   "start farther away, higher, or choose another pitch")
        self.attempt_time = attempt_time


@dataclass(frozen=True)
class Search:
    """Search for manoeuvres within the limits of a vehicle and settings; searches within other limits can share the solver."""

    vehicle: Vehicle
    settings: PowerlineSettings
    formulation: Formulation
    solver: Solver

    def bounds(self, task: Task, times: np.ndarray, states: np.ndarray, rates: np.ndarray) -> tuple[Certificate, ...]:
        """Certificates of a simulated flight: all limits and the errors at its end."""
        lines = [line.with_reduced_radius(task.radius_reduction) for line in task.request.lines]
        return (*certify(self.vehicle, times, states, rates, lines, self.settings.height_min, self._thrust_max(task)),
                *certify_end(times, states, task.goal, *task.accuracy))

    def _thrust_max(self, task: Task) -> float:
        """Greatest thrust of a rotor that a plan may use [N]."""
        return max(self.settings.thrust_share * self.vehicle.thrust_max, float(task.request.start[THRUST].max()))

    def perch(self, request: PowerlineRequest, pose: PerchPose) -> Task:
        """Return the task of a perch from the start of a request to a pose."""
        s, formulation, target = self.settings, self.formulation, request.target()
        yaw_turn = b3_turn = 0.0
        if request.perception:
            q_BC = quat_from_matrix(self.vehicle.mounts[s.camera].R_BC)
            path = target.closest_point(pose.p_WB) - request.start[P]
            yaw_turn = guess.facing_turn(request.start[Q], q_BC, path)
            b3_turn = guess.side_turn(request.start[Q], q_BC, target.direction, path)
        T0 = guess.perch_duration(request.start, pose.p_WB)

        def first_guess(attempt: int, intervals: int) -> tuple[np.ndarray, np.ndarray]:
            return guess.perch_guess(self.solver.model, request.start, pose.p_WB, pose.s3_W, s.height_min + 0.05, intervals,
                                     T0 * (1.0, 1.3, 0.8, 1.6, 1.1, 0.9)[attempt], yaw_turn, b3_turn)

        margins, _ = self._end_margins(request.start, request.lines, pose.p_WB[2])
        approaching = min(margins.approaching, _clearance_margin(self._clearance(request.start, request.lines)))
        end_clearance_max = _clearance_margin(0.5 * self._clearance(np.concatenate([pose.p_WB, pose.q_WB]), request.lines))
        return Task(
            "perch", request, pose, _select_lines(request.lines, target, request.start[P], pose.p_WB), formulation.perch,
            "perched" if formulation.hard_end else "", s.duration, margins, first_guess, formulation.accuracy, approaching=approaching,
            end_clearance_max=end_clearance_max)

    def recovery(self, request: PowerlineRequest, hover: np.ndarray) -> Task:
        """Return the task of a recovery from the start of a request towards a hover position [m], without perception."""
        s, formulation, start = self.settings, self.formulation, request.start
        margins, reduction = self._end_margins(start, request.lines)

        def first_guess(attempt: int, intervals: int) -> tuple[np.ndarray, np.ndarray]:
            return guess.recovery_guess(self.solver.model, start, hover, s.height_min + 0.1, intervals, (1.2, 0.9, 1.6, 1.9, 0.7, 1.4)[attempt])

        nearest = min(request.lines, key=lambda line: float(line.distance(start[P])), default=None)
        return Task(
            "recovery", replace(request, perception=False), PerchPose(hover, E3), _select_lines(request.lines, nearest, start[P], hover),
            formulation.recovery, "hovering" if formulation.hard_end else "", s.recovery_duration, margins, first_guess,
            (np.inf, *formulation.accuracy[1:]), leaving=margins.leaving, radius_reduction=reduction)

    def _end_margins(self, start: np.ndarray, lines: tuple[Segment, ...], end_height: float = np.inf) -> tuple[Margins, float]:
        """Margins that the ends of a manoeuvre permit, and the reduction of the wires' radii [m] with which its start is clear of them.

        The margin of height is at most half of what the lower end is above height_min, that of clearance at most half of the start's.

        Raises:
            PlanningRefusal: at the start the body cuts a wire, even one of reduced radius.
        """
        margins, clearance = self.settings.margins, np.inf
        height = min(margins.height, max(0.0, 0.5 * (min(start[2], end_height) - self.settings.height_min)))
        for reduction in (0.0, RADIUS_REDUCTION):
            reduced_lines = [line.with_reduced_radius(reduction) for line in lines]
            clearance = self._clearance(start, reduced_lines)
            if clearance > 0:
                return replace(margins, height=height, clearance=min(margins.clearance, 0.5 * _clearance_margin(clearance))), reduction
        raise PlanningRefusal("start_invalid", "clearance [P:eq14j]", clearance,
                              f"no recovery: at the start the body cuts a line, even with its radius reduced by {RADIUS_REDUCTION:g} m: "
                              f"scaled distance {1 + clearance:.2f} < 1")

    def _clearance(self, state: np.ndarray, lines: Sequence[Segment]) -> float:
        """Scaled distance of the nearest line from the body, less 1, at a state; inf without lines."""
        return min((float(scaled_clearance(state[None, P], state[None, Q], line, self.vehicle.body_radii)[0]) for line in lines),
                   default=np.inf)

    def solve_and_check(self, task: Task, start_phase: str = "gauss_newton", first: int = 0, guesses: int = ATTEMPTS) -> Manoeuvre:
        """Solve, simulate and check until the check passes.

        Args:
            task: the manoeuvre.
            start_phase: phase of the solver that starts from an initial guess.
            first: index of the first attempt.
            guesses: number of attempts after which to give up where none has converged.

        Raises:
            PlanningRefusal: no manoeuvre passed the check.
        """
        s, vehicle, thrust_max = self.settings, self.vehicle, self._thrust_max(task)
        margins, margin_scale, intervals, lines, solver_name = task.margins, MARGIN_DECAY**first, s.intervals, task.lines, task.request.solver
        iterations, time, cpu_time, attempt_time, first_violated, previous, phase, refined = 0, 0.0, 0.0, 0.0, None, None, start_phase, 0
        for attempt in range(first, ATTEMPTS):
            if attempt > first and time + attempt_time > task.request.deadline:  # a refusal with its cause is worth more than being stopped
                break
            states, inputs = previous if previous is not None else task.guess(attempt, intervals)
            data = ProblemData(
                start=task.request.start, reference=np.concatenate([task.goal.p_WB, task.goal.s3_W, task.goal.v_W, np.zeros(3)]),
                lines=np.array([line_parameters(line.with_reduced_radius(task.radius_reduction)) for line in lines]).reshape(-1, 8),
                run_weights=run_weights(task.weights, self.formulation.ramp, vehicle.thrust_rate_max, intervals),
                end_weights=end_weights(task.weights), perception_weights=perception_weights(s.perception, intervals), duration=task.duration,
                height_min=s.height_min + margins.height, thrust=(vehicle.thrust_min + margins.thrust, thrust_max - margins.thrust),
                body_rate=vehicle.body_rate_max - margins.body_rate, states=states, inputs=inputs,
                clearance=_clearances(margins.clearance, margin_scale * task.leaving, margin_scale * task.approaching, task.end_clearance_max, intervals),
                defects=np.zeros((intervals, STATES + 1)), end_tolerance=end_tolerances(task.end, *task.accuracy))
            found = self.solver.solve(Structure(intervals, len(lines), task.request.perception, task.end, solver_name), data, phase)
            iterations, time, cpu_time = iterations + found.iterations, time + found.time, cpu_time + found.cpu_time
            attempt_time = attempt_time or time
            if not (found.converged and np.all(np.isfinite(found.states))):
                if first_violated is None and attempt + 1 >= guesses:
                    break
                previous, phase, margin_scale = None, start_phase, MARGIN_DECAY * margin_scale
                solver_name = "ipopt" if attempt >= 1 else solver_name
                continue
            rates = vehicle.thrust_rate_max * np.clip(found.inputs, -1.0, 1.0)
            times, simulated, rates = simulate(self.solver.model, task.request.start, rates, found.duration)
            bounds = self.bounds(task, times, simulated, rates)
            violated = [bound for bound in bounds if not bound.holds]
            if not violated:
                return Manoeuvre(times, simulated, rates, bounds, intervals, solver_name, iterations, time, cpu_time, found.cost)
            first_violated = violated[0]
            lines = _with_missing_line(lines, task.request.lines, simulated, max(vehicle.body_radii))
            only_end_missed = all(bound.quantity.startswith("end_") for bound in violated)
            refine = only_end_missed and refined < REFINEMENTS
            refined = refined + 1 if refine else 0
            if not refine:
                intervals = int(np.ceil(1.5 * intervals))
                margin_scale *= MARGIN_DECAY if only_end_missed else 1.0
            previous, phase = _resampled(found, intervals), "refine" if refine else "solve"
        if first_violated is not None:
            raise PlanningRefusal("infeasible", first_violated.quantity, first_violated.margin, f"no {task.name} within the limits: {first_violated}")
        raise NotConverged(task.name, found.status, attempt_time)


def _clearance_margin(clearance: float) -> float:
    """(d^2 - 1) / (d^2 + 1) of a scaled distance d = 1 + clearance: the unit of clearance margins."""
    return 1.0 if np.isinf(clearance) else ((1 + clearance) ** 2 - 1) / ((1 + clearance) ** 2 + 1)


def _clearances(least: float, leaving: float, approaching: float, end_clearance_max: float, intervals: int) -> np.ndarray:
    """Clearance margins of all nodes but the first, shape (N,): `least` near a wire at start or end, more in between."""
    past = np.arange(1, intervals + 1) / intervals
    between = np.maximum(np.minimum(4.0 * past, 1.0) * (leaving - least), np.minimum(10.0 * (1.0 - past), 1.0) * (approaching - least))
    return np.minimum(least + np.maximum(between, 0.0), end_clearance_max + 10.0 * (1.0 - past))


def _select_lines(lines: tuple[Segment, ...], target: Segment | None, start: np.ndarray, end: np.ndarray) -> tuple[Segment, ...]:
    """Lines of the problem: the target first, then the others nearest to the straight path, at most `LINES_MAX`."""
    path = np.linspace(start, end, 20)
    return tuple(sorted(lines, key=lambda line: (line is not target, float(line.distance(path).min())))[:LINES_MAX])


def _with_missing_line(lines: tuple[Segment, ...], known: tuple[Segment, ...], simulated: np.ndarray, reach: float) -> tuple[Segment, ...]:
    """Add a missing line that the flight came too near to; where there are `LINES_MAX` lines, it replaces the last one."""
    present = {line.id for line in lines}
    for line in known:
        if line.id not in present and float(line.distance(simulated[:, P]).min()) < 1.2 * reach:
            return (*lines[: LINES_MAX - 1], line)
    return lines


def _resampled(found: Solution, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """Resample a solution as the guess for another N: states interpolated, inputs held."""
    old = len(found.inputs)
    if old == intervals:
        return found.states, found.inputs
    s_old, s_new = np.linspace(0, 1, old + 1), np.linspace(0, 1, intervals + 1)
    states = np.stack([np.interp(s_new, s_old, column) for column in found.states.T], axis=1)
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    states[:, STATES] = found.duration
    rows = np.minimum((s_new[:-1] * old).astype(int), old - 1)
    return states, found.inputs[rows]
