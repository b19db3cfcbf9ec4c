"""Perch and recovery: solve, fly at 1 ms, check, and solve again where the check fails. [P:V-B, P:Fig.3]"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from perch_core import rotor_model
from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment
from perch_core.rotor_model import P, Q, STATES, THRUST, V, W
from perch_core.so3 import quat_from_matrix
from perch_core.trajectory import SampledTrajectory
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline import guess
from perch_planner.powerline.certificate import Bound, certify, certify_end
from perch_planner.powerline.flight import fly
from perch_planner.powerline.nlp import Numbers, Solution, Structure
from perch_planner.powerline.request import E3, PerchPose, PowerlineRequest
from perch_planner.powerline.settings import Margins, PowerlineSettings
from perch_planner.powerline.solving import PHASES, Solver, end_weights, run_weights, see_weights
from perch_planner.powerline.stage_functions import line_parameters
from perch_planner.powerline.validation import check_request

LINES_MAX = 6  # segments in the problem: the target and the nearest others; the check takes all
ATTEMPTS = 6  # solves of one manoeuvre: margins raised, then N, then another guess and solver
RADIUS_REDUCTION = 0.02  # the paper's, for the recovery, which starts at the wire [m]


@dataclass(frozen=True)
class Manoeuvre:
    """A checked perch or recovery.

    Attributes:
        times: [s], shape (m,), from 0, about 1 ms apart.
        states: shape (m, 17), see `rotor_model`.
        rates: thrust rates [N/s], shape (m, 4).
        bounds: what was checked.
        intervals: N of the accepted solve.
        solver: fatrop or ipopt.
        iterations: of all solves.
        solve_time: wall-clock time of all solves [s].
        cpu_time: processor time of all solves [s]; on a quiet machine the same.
        cost: value of [P:eq14a].
    """

    times: np.ndarray
    states: np.ndarray
    rates: np.ndarray
    bounds: tuple[Bound, ...]
    intervals: int
    solver: str
    iterations: int
    solve_time: float
    cpu_time: float
    cost: float

    @property
    def duration(self) -> float:
        """T [s]."""
        return float(self.times[-1])


@dataclass(frozen=True)
class PowerlinePlan:
    """A perch, a recovery, or one after the other."""

    perch: Manoeuvre | None
    recovery: Manoeuvre | None

    @property
    def parts(self) -> tuple[Manoeuvre, ...]:
        """Perch and recovery, in order, without those that were not asked for."""
        return tuple(part for part in (self.perch, self.recovery) if part is not None)

    @property
    def bounds(self) -> tuple[Bound, ...]:
        """Every certificate; those of an appended recovery are named `recovery_*`."""
        if self.perch is None or self.recovery is None:
            return tuple(bound for part in self.parts for bound in part.bounds)
        shift = self.perch.duration
        late = (replace(b, quantity=f"recovery_{b.quantity}", time_of_minimum=b.time_of_minimum + shift,
                        time_of_maximum=b.time_of_maximum + shift) for b in self.recovery.bounds)
        return (*self.perch.bounds, *late)

    def trajectory(self, model: rotor_model.RotorModel, start_time: float = 0.0, step: float = 0.0) -> SampledTrajectory:
        """Perch and recovery as one trajectory for the controller.

        Args:
            model: constants.
            start_time: stamp of the start [s].
            step: wanted spacing of the samples [s]; 0: all, about 1 ms. Start, end and the joint are always there.
        """
        times, states = [], []
        begin = 0.0
        for part in self.parts:
            stride = max(1, round(step * (len(part.times) - 1) / part.duration))
            rows = np.append(np.arange(0, len(part.times) - 1, stride), len(part.times) - 1)[1 if times else 0:]
            times.append(begin + part.times[rows])
            states.append(part.states[rows])
            begin += part.duration
        times, states = np.concatenate(times), np.concatenate(states)
        a_W, dw_B = rotor_model.accelerations(model, states)
        return SampledTrajectory(times=times, p=states[:, P], q=states[:, Q], v=states[:, V], w=states[:, W], a=a_W,
                                 dw=dw_B, rotor_thrust=states[:, THRUST], start_time=start_time)


@dataclass
class PowerlinePlanner:
    """Plans for one vehicle. Building it loads the compiled functions, and compiles them the first time on a machine."""

    vehicle: Vehicle
    settings: PowerlineSettings = field(default_factory=PowerlineSettings)
    gravity: float = GRAVITY
    solver: Solver = field(init=False)

    def __post_init__(self) -> None:
        self.solver = Solver(self.vehicle, self.gravity, self.settings.camera, self.settings.correct_drift)

    def warm_up(self, lines: int = 3) -> None:
        """Build the solvers of the usual structures beforehand, so that the first plan is as fast as the others."""
        for perception in (False, True):
            for phase in PHASES:
                self.solver.problem(Structure(self.settings.intervals, lines, perception, self.settings.solver), phase)

    def plan(self, request: PowerlineRequest) -> PowerlinePlan:
        """Plan a perch with its recovery, or a recovery alone.

        Raises:
            PlanningRefusal: bad request, or no trajectory within the limits was found.
        """
        check_request(request, self.vehicle, self.settings)
        if request.recovery_only:
            hover = request.start[P] if request.hover is None else request.hover
            return PowerlinePlan(None, self._recovery(request, request.start, hover))
        perch = self._perch(request)
        recovery = None
        if request.with_recovery:
            recovery = self._recovery(request, perch.states[-1], request.start[P] if request.hover is None else request.hover)
        return PowerlinePlan(perch, recovery)

    def _perch(self, request: PowerlineRequest) -> Manoeuvre:
        s = self.settings
        pose = request.perch
        target = request.target()
        turn = 0.0
        if request.perception:
            q_BC = quat_from_matrix(self.vehicle.mounts[s.camera].R_BC)
            turn = guess.facing_turn(request.start[Q], q_BC, target.closest_point(pose.p_WB) - request.start[P])
        T0 = guess.perch_duration(request.start, pose.p_WB)

        def first_guess(attempt: int, intervals: int) -> tuple[np.ndarray, np.ndarray]:
            return guess.perch_guess(self.solver.model, request.start, pose.p_WB, pose.s3_W, s.height_min + 0.05, intervals,
                                     T0 * (1.0, 1.3, 0.8, 1.6, 1.1)[attempt % 5], turn)

        def end_check(times: np.ndarray, states: np.ndarray) -> tuple[Bound, ...]:
            return certify_end(times, states, pose, s.accuracy.position, s.accuracy.tilt_deg, s.accuracy.speed)

        reference = np.concatenate([pose.p_WB, pose.s3_W, pose.v_W, np.zeros(3)])
        lines = self._relevant(request.lines, target, request.start[P], pose.p_WB)
        return self._solve("perch", request, request.start, reference, lines, s.perch, s.duration, first_guess, end_check,
                           np.full(6, s.end_factor))

    def _recovery(self, request: PowerlineRequest, start: np.ndarray, hover: np.ndarray) -> Manoeuvre:
        s = self.settings
        upright = PerchPose(np.asarray(hover, float), E3)
        start = start.copy()
        start[THRUST] = np.clip(start[THRUST], self.vehicle.thrust_min, s.thrust_share * self.vehicle.thrust_max)

        def first_guess(attempt: int, intervals: int) -> tuple[np.ndarray, np.ndarray]:
            return guess.recovery_guess(self.solver.model, start, hover, s.height_min + 0.1, intervals,
                                        (1.2, 0.9, 1.6, 1.9, 0.7)[attempt % 5])

        def end_check(times: np.ndarray, states: np.ndarray) -> tuple[Bound, ...]:
            return certify_end(times, states, upright, np.inf, s.accuracy.tilt_deg, s.accuracy.speed)

        reference = np.concatenate([upright.p_WB, E3, np.zeros(6)])
        near = min(request.lines, key=lambda line: float(line.distance(start[P]))) if request.lines else None
        lines = self._relevant(request.lines, near, start[P], upright.p_WB)
        return self._solve("recovery", replace(request, perception=False), start, reference, lines, s.recovery,
                           s.recovery_duration, first_guess, end_check,
                           np.array([1.0, 1.0, *[s.end_factor] * 4]))  # upright and at rest, but not at one place

    def _solve(self, name, request, start, reference, lines, weights, duration, first_guess, end_check, end_factor) -> Manoeuvre:
        s, vehicle = self.settings, self.vehicle
        thrust_max = max(s.thrust_share * vehicle.thrust_max, float(start[THRUST].max()))
        margins, intervals = s.margins, s.intervals
        solver_name = request.solver or s.solver
        iterations, time, cpu_time, worst, previous, phase = 0, 0.0, 0.0, None, None, "first"
        for attempt in range(ATTEMPTS):
            states, inputs = previous if previous is not None else first_guess(attempt, intervals)
            numbers = Numbers(
                start=start, reference=reference, lines=np.array([line_parameters(line) for line in lines]).reshape(-1, 8),
                run_weights=run_weights(weights, s.ramp, vehicle.thrust_rate_max, intervals), end_weights=end_weights(weights),
                see_weights=see_weights(s.perception, intervals), duration=duration,
                height_min=s.height_min + margins.height,
                thrust=(vehicle.thrust_min + margins.thrust, thrust_max - margins.thrust),
                body_rate=vehicle.body_rate_max - margins.body_rate, clearance=margins.clearance, states=states, inputs=inputs,
                defects=np.zeros((intervals, STATES + 1)))
            structure = Structure(intervals, len(lines), request.perception, solver_name)
            found = self.solver.solve(structure, numbers, numbers.end_weights * end_factor, phase)
            iterations, time, cpu_time = iterations + found.iterations, time + found.time, cpu_time + found.cpu_time
            if not (found.converged and np.all(np.isfinite(found.states))):
                previous, phase = None, "first"
                if attempt >= 1:
                    solver_name = "ipopt"
                continue
            rates = vehicle.thrust_rate_max * np.clip(found.inputs, -1.0, 1.0)
            times, flown, dense_rates = fly(self.solver.model, start, rates, found.duration)
            bounds = certify(vehicle, times, flown, dense_rates, request.lines, s.height_min, thrust_max) + end_check(times, flown)
            broken = [bound for bound in bounds if not bound.holds]
            if not broken:
                return Manoeuvre(times, flown, dense_rates, bounds, intervals, solver_name, iterations, time, cpu_time,
                                  found.cost)
            worst = broken[0]
            only_end = all(bound.quantity.startswith("end_") for bound in broken)
            margins, lines = self._tightened(margins, broken), self._joined(lines, request.lines, flown)
            if attempt >= 2 and not only_end:
                intervals = int(np.ceil(1.5 * intervals))
            previous, phase = _resampled(found, intervals), "polish" if only_end else "second"
        if worst is not None:
            raise PlanningRefusal("infeasible", worst.quantity, worst.margin, f"no {name} within the limits: {worst}")
        raise PlanningRefusal("infeasible", name, -1.0,
                              f"no {name} was found: the solver did not converge from {ATTEMPTS} guesses ({found.status}); "
                              "start farther away, higher, or choose another pitch")

    def _tightened(self, margins: Margins, broken: list[Bound]) -> Margins:
        raised = {}
        for bound in broken:
            if bound.quantity in ("height", "clearance", "thrust", "body_rate"):
                raised[bound.quantity] = getattr(margins, bound.quantity) + 1.5 * abs(bound.margin) + 1e-3
        return replace(margins, **raised)

    def _relevant(self, lines: tuple[Segment, ...], target: Segment | None, start: np.ndarray, end: np.ndarray) -> list[Segment]:
        """The target first, then the others nearest to the straight way."""
        way = np.linspace(start, end, 20)
        others = sorted((line for line in lines if line is not target), key=lambda line: float(line.distance(way).min()))
        return ([target] if target is not None else []) + others[: LINES_MAX - 1]

    def _joined(self, lines: list[Segment], known: tuple[Segment, ...], flown: np.ndarray) -> list[Segment]:
        """The lines of the problem, the last replaced by one that the flight came too near to without its being there."""
        known_ids = {line.id for line in lines}
        for line in known:
            if line.id not in known_ids and float(line.distance(flown[:, P]).min()) < 1.2 * max(self.vehicle.body_radii):
                return [*lines[: LINES_MAX - 1], line]
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
