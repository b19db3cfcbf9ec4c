"""Perch and recovery: solve, fly at 1 ms, check, and solve again where the check fails. [P:V-B, P:Fig.3]"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment, scaled_clearance
from perch_core.rotor_model import P, Q, STATES, THRUST
from perch_core.so3 import quat_from_matrix
from perch_core.values import Certificate
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline import guess
from perch_planner.powerline.certificate import certify, certify_end
from perch_planner.powerline.flight import fly
from perch_planner.powerline.formulation import OURS, Formulation, Weights
from perch_planner.powerline.nlp import Numbers, Solution, Structure
from perch_planner.powerline.plan import Manoeuvre, PowerlinePlan
from perch_planner.powerline.relaxation import RELAXATIONS
from perch_planner.powerline.request import E3, PerchPose, PowerlineRequest
from perch_planner.powerline.settings import Margins, PowerlineSettings
from perch_planner.powerline.solving import PHASES, Solver, end_room, end_weights, run_weights, see_weights
from perch_planner.powerline.stage_functions import line_parameters
from perch_planner.powerline.validation import check_request

LINES_MAX = 6  # segments in the problem: the target and the nearest others; the check takes all
ATTEMPTS = 6  # solves of one manoeuvre: with a larger N, or from another guess and with another solver
FIRST_GUESSES = 2  # of a perch, before the limits are tried one at a time, and then IPOPT
LAST_RESORT = 7.0  # times of a first attempt that does not converge, which IPOPT's greatest number of iterations takes
EASED = 0.75  # of `leaving` and `approaching`, after each solve that finds no plan to the end: they are wishes, unlike the limits
RADIUS_REDUCTION = 0.02  # the paper's, for a recovery that starts at the wire: part of a wire's radius is safety [m]


@dataclass(frozen=True)
class _Task:
    """One manoeuvre to solve: a perch or a recovery.

    Attributes:
        name: for messages.
        start: shape (17,).
        wanted: end pose and velocity.
        lines: in the problem, the target first.
        known: every line, for the check.
        perception: keep the first line in view.
        weights: of the costs.
        end: what vanishes at the end, see `nlp.Structure`.
        duration: bounds of T [s].
        margins: by which the nodes keep away from the limits.
        leaving: clearance that the margins grow to within a quarter of the time, if there is a plan; 0: they stay as they are.
        approaching: clearance that they have until a tenth of the time before the end, if there is a plan; 0: the same.
        at_end: clearance that the wanted pose leaves, which no margin exceeds there; 1: any.
        radius_reduction: taken off the wires' radius [m].
        guess: attempt and N -> states and inputs.
        accuracy: position [m], tilt [deg], speed [m/s] at the end; inf: any.
        solver: first choice.
        deadline: time of all solves after which no further attempt is begun [s].
    """

    name: str
    start: np.ndarray
    wanted: PerchPose
    lines: tuple[Segment, ...]
    known: tuple[Segment, ...]
    perception: bool
    weights: Weights
    end: str
    duration: tuple[float, float]
    margins: Margins
    leaving: float
    approaching: float
    at_end: float
    radius_reduction: float
    guess: Callable[[int, int], tuple[np.ndarray, np.ndarray]]
    accuracy: tuple[float, float, float]
    solver: str
    deadline: float


class _NotConverged(PlanningRefusal):
    """No manoeuvre was found, and nothing says which limit is the cause.

    Attributes:
        patience: time of the first attempt [s]; a trial without a limit, with half as many iterations, takes less.
    """

    def __init__(self, name: str, tried: str, patience: float) -> None:
        super().__init__("infeasible", name, -1.0, f"no {name} was found: the solver did not converge from several guesses ({tried}); "
                                                   "start farther away, higher, or choose another pitch")
        self.patience = patience


@dataclass
class PowerlinePlanner:
    """Plans for one vehicle. Building it loads the compiled functions, and compiles them the first time on a machine."""

    vehicle: Vehicle
    settings: PowerlineSettings = field(default_factory=PowerlineSettings)
    gravity: float = GRAVITY
    formulation: Formulation = OURS
    solver: Solver = field(init=False)

    def __post_init__(self) -> None:
        self.solver = Solver(self.vehicle, self.gravity, self.settings.camera)

    def warm_up(self, lines: int = 3) -> None:
        """Build the solvers of the usual structures beforehand, so that the first plan is as fast as the others."""
        for perception, end in ((False, "perched"), (True, "perched"), (False, "hovering")):
            for phase in PHASES:
                if phase != "trial" and (perception or phase != "sight"):  # nobody solves that one without perception costs
                    self.solver.problem(Structure(self.settings.intervals, lines, perception, end), phase)

    def plan(self, request: PowerlineRequest) -> PowerlinePlan:
        """Plan a perch with its recovery, or a recovery alone; a perch after which no recovery is found says so.

        Raises:
            PlanningRefusal: bad request, or no trajectory within the limits was found.
        """
        began = perf_counter()
        pose = check_request(request, self.vehicle, self.settings)
        request = replace(request, start=self._started(request.start))
        hover = request.start[P] if request.hover is None else np.asarray(request.hover, float)
        if pose is None:
            return PowerlinePlan(None, self._fly(self._recovery(request, request.start, hover)))
        perch = self._fly_perch(request, pose, began)
        if not request.with_recovery:
            return PowerlinePlan(perch, None)
        try:
            return PowerlinePlan(perch, self._fly(self._recovery(request, perch.states[-1], hover)))
        except PlanningRefusal as refusal:
            return PowerlinePlan(perch, None, str(refusal))

    def _fly_perch(self, request: PowerlineRequest, pose: PerchPose, began: float) -> Manoeuvre:
        """A perch; where the first guesses lead to none, the limits are tried first, and then IPOPT while there is time.

        Raises:
            PlanningRefusal: there is none; it names the limit without which there is one.
        """
        task = self._perch(request, pose)
        until = began + task.deadline
        try:
            return self._fly(task, guesses=FIRST_GUESSES)
        except _NotConverged as refusal:
            found, patience = self._relaxed(request, pose, task, refusal, until), refusal.patience
        if isinstance(found, Manoeuvre):
            return found
        left = until - perf_counter() - (LAST_RESORT * patience if found.constraint != task.name else 0.0)  # a cause must not be lost
        if left <= 0.0:
            raise found
        try:
            return self._fly(replace(task, solver="ipopt", deadline=left), first=FIRST_GUESSES)
        except _NotConverged:
            raise found from None

    def _relaxed(self, request: PowerlineRequest, pose: PerchPose, task: _Task, refusal: _NotConverged, until: float) -> Manoeuvre | PlanningRefusal:
        """A refusal that names the first limit without which a perch is soon found; that perch, where it keeps all limits."""
        for relaxation in RELAXATIONS:
            if perf_counter() + refusal.patience > until:
                return PlanningRefusal(refusal.code, refusal.constraint, refusal.margin,
                                       f"{refusal}; no time was left to look for the cause, allow more than {task.deadline:g} s")
            other = copy.copy(self)
            changed, other.settings, other.vehicle = relaxation.relaxed(replace(request, solver="fatrop"), self.settings, self.vehicle)
            try:
                found = other._fly(other._perch(changed, pose), "trial", guesses=1)
            except PlanningRefusal:
                continue
            bounds = self._bounds(task, found.times, found.states, found.rates)
            broken = {str(bound): bound.margin for bound in bounds if not bound.holds}
            if found.duration > task.duration[1]:
                broken[f"duration {found.duration:.2f} s, required at most {task.duration[1]:g} s"] = task.duration[1] - found.duration
            if not broken:
                return replace(found, bounds=bounds)
            words, margin = next(iter(broken.items()))
            return PlanningRefusal(refusal.code, relaxation.constraint, margin,
                                   f"no perch was found that keeps the {relaxation.words}; without it there is one: {words}")
        tried = ", ".join(relaxation.words for relaxation in RELAXATIONS)
        return PlanningRefusal(refusal.code, refusal.constraint, refusal.margin, f"{refusal}; none of these alone is seen to be the cause: {tried}")

    def _bounds(self, task: _Task, times: np.ndarray, states: np.ndarray, rates: np.ndarray) -> tuple[Certificate, ...]:
        """Certificates of a flight: all limits and its end."""
        return (*certify(self.vehicle, times, states, rates, task.known, self.settings.height_min, self._thrust_max(task), task.radius_reduction),
                *certify_end(times, states, task.wanted, *task.accuracy))

    def _thrust_max(self, task: _Task) -> float:
        """Greatest thrust of a rotor that a plan may use [N]."""
        return max(self.settings.thrust_share * self.vehicle.thrust_max, float(task.start[THRUST].max()))

    def _started(self, start: np.ndarray) -> np.ndarray:
        """A start with a unit quaternion, and thrusts that the rotors have: a state that was measured is off by a little."""
        start = start.copy()
        start[Q] /= np.linalg.norm(start[Q])
        start[THRUST] = np.clip(start[THRUST], self.vehicle.thrust_min, self.vehicle.thrust_max)
        return start

    def _perch(self, request: PowerlineRequest, pose: PerchPose) -> _Task:
        s, formulation, target = self.settings, self.formulation, request.target()
        turn = aside = 0.0
        if request.perception:
            q_BC = quat_from_matrix(self.vehicle.mounts[s.camera].R_BC)
            way = target.closest_point(pose.p_WB) - request.start[P]
            turn = guess.facing_turn(request.start[Q], q_BC, way)
            aside = guess.side_turn(request.start[Q], q_BC, target.direction, way)
        T0 = guess.perch_duration(request.start, pose.p_WB)

        def first_guess(attempt: int, intervals: int) -> tuple[np.ndarray, np.ndarray]:
            return guess.perch_guess(self.solver.model, request.start, pose.p_WB, pose.s3_W, s.height_min + 0.05, intervals,
                                     T0 * (1.0, 1.3, 0.8, 1.6, 1.1, 0.9)[attempt], turn, aside)

        approaching = min(s.margins.approaching, _share(self._clearance(request.start, request.lines)))
        at_end = _share(0.5 * self._clearance(np.concatenate([pose.p_WB, pose.q_WB]), request.lines))
        return _Task("perch", request.start, pose, _relevant(request.lines, target, request.start[P], pose.p_WB), request.lines,
                     request.perception, formulation.perch, "perched" if formulation.hard_end else "", s.duration, s.margins, 0.0, approaching, at_end,
                     0.0, first_guess, formulation.accuracy, request.solver, request.deadline or s.deadline)

    def _recovery(self, request: PowerlineRequest, start: np.ndarray, hover: np.ndarray) -> _Task:
        s, formulation = self.settings, self.formulation
        margins, reduction = self._room(start, request.lines)

        def first_guess(attempt: int, intervals: int) -> tuple[np.ndarray, np.ndarray]:
            return guess.recovery_guess(self.solver.model, start, hover, s.height_min + 0.1, intervals,
                                        (1.2, 0.9, 1.6, 1.9, 0.7, 1.4)[attempt])

        nearest = min(request.lines, key=lambda line: float(line.distance(start[P])), default=None)
        return _Task("recovery", start, PerchPose(hover, E3), _relevant(request.lines, nearest, start[P], hover), request.lines,
                     False, formulation.recovery, "hovering" if formulation.hard_end else "", s.recovery_duration, margins, margins.leaving,
                     0.0, 1.0, reduction, first_guess,
                     (np.inf, *formulation.accuracy[1:]), request.solver, request.deadline or s.deadline)

    def _room(self, start: np.ndarray, lines: tuple[Segment, ...]) -> tuple[Margins, float]:
        """Margins that the start of a recovery leaves, and what to take off the wires' radii for it to begin free.

        Raises:
            PlanningRefusal: the body cuts a wire by more than that.
        """
        margins, clearance = self.settings.margins, np.inf
        height = min(margins.height, max(0.0, 0.5 * (start[2] - self.settings.height_min)))
        for reduction in (0.0, RADIUS_REDUCTION):
            thin = [replace(line, radius=max(line.radius - reduction, 1e-3)) for line in lines]
            clearance = self._clearance(start, thin)
            if clearance > 0:
                return replace(margins, height=height, clearance=min(margins.clearance, 0.5 * _share(clearance))), reduction
        raise PlanningRefusal("start_invalid", "clearance [P:eq14j]", clearance,
                              f"no recovery: the body cuts a line, scaled distance {1 + clearance:.2f} < 1")

    def _clearance(self, state: np.ndarray, lines: Sequence[Segment]) -> float:
        """Scaled distance of the nearest line from the body, less 1, at a state (17,); inf without lines."""
        return min((float(scaled_clearance(state[None, P], state[None, Q], line, self.vehicle.body_radii)[0]) for line in lines),
                   default=np.inf)

    def _fly(self, task: _Task, cold: str = "sight", first: int = 0, guesses: int = ATTEMPTS) -> Manoeuvre:
        """Solve, fly and check until the check passes.

        Args:
            task: what to solve.
            cold: phase that begins from a guess.
            first: attempt to begin with.
            guesses: attempts of which one at least must converge.

        Raises:
            PlanningRefusal: it does not.
        """
        s, vehicle = self.settings, self.vehicle
        thrust_max = self._thrust_max(task)
        margins, wish, intervals, lines, solver_name = task.margins, EASED**first, s.intervals, task.lines, task.solver
        iterations, time, cpu_time, worst, previous, phase = 0, 0.0, 0.0, None, None, cold
        patience = 0.0
        for attempt in range(first, ATTEMPTS):
            if time > task.deadline:  # a refusal with its cause is worth more than being stopped
                break
            states, inputs = previous if previous is not None else task.guess(attempt, intervals)
            numbers = Numbers(
                start=task.start, reference=np.concatenate([task.wanted.p_WB, task.wanted.s3_W, task.wanted.v_W, np.zeros(3)]),
                lines=np.array([line_parameters(line, task.radius_reduction) for line in lines]).reshape(-1, 8),
                run_weights=run_weights(task.weights, self.formulation.ramp, vehicle.thrust_rate_max, intervals),
                end_weights=end_weights(task.weights), see_weights=see_weights(s.perception, intervals), duration=task.duration,
                height_min=s.height_min + margins.height,
                thrust=(vehicle.thrust_min + margins.thrust, thrust_max - margins.thrust),
                body_rate=vehicle.body_rate_max - margins.body_rate, states=states, inputs=inputs,
                clearance=_clearances(margins.clearance, wish * task.leaving, wish * task.approaching, task.at_end, intervals),
                defects=np.zeros((intervals, STATES + 1)), end_room=end_room(task.end, *task.accuracy))
            structure = Structure(intervals, len(lines), task.perception, task.end, solver_name)
            found = self.solver.solve(structure, numbers, phase)
            iterations, time, cpu_time = iterations + found.iterations, time + found.time, cpu_time + found.cpu_time
            patience = patience or time
            if not (found.converged and np.all(np.isfinite(found.states))):
                if worst is None and attempt + 1 >= guesses:
                    break
                previous, phase, wish = None, cold, EASED * wish
                solver_name = "ipopt" if attempt >= 1 else solver_name
                continue
            rates = vehicle.thrust_rate_max * np.clip(found.inputs, -1.0, 1.0)
            times, flown, dense_rates = fly(self.solver.model, task.start, rates, found.duration)
            bounds = self._bounds(task, times, flown, dense_rates)
            broken = [bound for bound in bounds if not bound.holds]
            if not broken:
                return Manoeuvre(times, flown, dense_rates, bounds, intervals, solver_name, iterations, time, cpu_time,
                                 found.cost)
            worst = broken[0]
            lines = _joined(lines, task.known, flown, max(vehicle.body_radii))
            missed = all(bound.quantity.startswith("end_") for bound in broken)
            drifted = missed and phase != "polish"
            if not drifted:
                intervals = int(np.ceil(1.5 * intervals))
                wish *= EASED if missed else 1.0
            previous, phase = _resampled(found, intervals), "polish" if drifted else "solve"
        if worst is not None:
            raise PlanningRefusal("infeasible", worst.quantity, worst.margin, f"no {task.name} within the limits: {worst}")
        raise _NotConverged(task.name, found.status, patience)


def _share(clearance: float) -> float:
    """(d^2 - 1) / (d^2 + 1) of a scaled distance d = 1 + clearance: what margins are counted in."""
    return 1.0 if np.isinf(clearance) else ((1 + clearance) ** 2 - 1) / ((1 + clearance) ** 2 + 1)


def _clearances(least: float, leaving: float, approaching: float, at_end: float, intervals: int) -> np.ndarray:
    """Clearance margins of all nodes but the first, shape (N,): `least` where a wire is left or met, more in the open."""
    past = np.arange(1, intervals + 1) / intervals
    open_air = np.maximum(np.minimum(4.0 * past, 1.0) * (leaving - least), np.minimum(10.0 * (1.0 - past), 1.0) * (approaching - least))
    return np.minimum(least + np.maximum(open_air, 0.0), at_end + 10.0 * (1.0 - past))


def _relevant(lines: tuple[Segment, ...], target: Segment | None, start: np.ndarray, end: np.ndarray) -> tuple[Segment, ...]:
    """The target first, then the others nearest to the straight way."""
    way = np.linspace(start, end, 20)
    others = sorted((line for line in lines if line is not target), key=lambda line: float(line.distance(way).min()))
    return (*([target] if target is not None else []), *others[: LINES_MAX - 1])


def _joined(lines: tuple[Segment, ...], known: tuple[Segment, ...], flown: np.ndarray, reach: float) -> tuple[Segment, ...]:
    """The lines of the problem, the last replaced by one that the flight came too near to without its being there."""
    present = {line.id for line in lines}
    for line in known:
        if line.id not in present and float(line.distance(flown[:, P]).min()) < 1.2 * reach:
            return (*lines[: LINES_MAX - 1], line)
    return lines


def _resampled(found: Solution, intervals: int) -> tuple[np.ndarray, np.ndarray]:
    """A solution as the guess for another N: states interpolated, inputs held."""
    old = len(found.inputs)
    if old == intervals:
        return found.states, found.inputs
    s_old, s_new = np.linspace(0, 1, old + 1), np.linspace(0, 1, intervals + 1)
    states = np.stack([np.interp(s_new, s_old, column) for column in found.states.T], axis=1)
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    states[:, STATES] = found.duration
    rows = np.minimum((s_new[:-1] * old).astype(int), old - 1)
    return states, found.inputs[rows]
