"""The two-phase solve: a loose first answer with the paper's end weights, then the end pinned down from there.

The paper's end weights leave up to 29 mm at the perch. Weights 300 times as large leave microns, but from a cold start the
solver needs twice the iterations; from the loose answer of the first phase it needs a dozen.

Perception costs bend down far from their minimum: with the exact Hessian fatrop then crawls behind its regularisation, 30 to
80 iterations. Gauss-Newton comes near in a dozen and would never arrive (it goes to and fro over the kinks of the soft
constraints), so that it is stopped there, and the second phase ends what it began.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from perch_core.rotor_model import RotorModel
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline import compiled
from perch_planner.powerline.formulation import Weights
from perch_planner.powerline.nlp import Numbers, Problem, Solution, Structure
from perch_planner.powerline.settings import PerceptionWeights
from perch_planner.powerline.stage_functions import StageFunctions, StageModel, stage_functions

# Phase: tolerance, first barrier parameter, push off active bounds. The nearer the guess, the smaller the latter two.
# "sight" is the first phase of a problem with perception costs.
PHASES: dict[str, dict[str, Any]] = {
    "first": {"tolerance": 1e-2},
    "sight": {"tolerance": 0.3, "max_iterations": 24, "gauss_newton": True},
    "second": {"tolerance": 1e-4, "barrier": 1e-4, "push": 1e-4},
    "polish": {"tolerance": 1e-5, "barrier": 1e-5, "push": 1e-7},
}

REPROJECTION_DECAY = 0.1  # of the cost [P:eq9], per thirtieth of the horizon
SOFT_DECAY = 0.3          # of the soft constraints [P:eq14h, P:eq14i], the same, from SOFT_UNTIL on
SOFT_UNTIL = 0.667        # share of the horizon


@dataclass
class Solver:
    """Solvers of one vehicle, built when first needed and kept.

    Attributes:
        vehicle: body, limits, cameras.
        gravity: [m/s^2].
        camera: name of the camera that the perception costs are about.
        correct_drift: remove the integrator's error, see `Problem.defects_of`.
    """

    vehicle: Vehicle
    gravity: float = GRAVITY
    camera: str = "front"
    correct_drift: bool = True
    model: RotorModel = field(init=False)
    compiled: bool = field(init=False)
    _stages: StageFunctions = field(init=False, repr=False)
    _problems: dict[tuple[Structure, str], Problem] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.model = RotorModel.of(self.vehicle, self.gravity)
        stage = StageModel.of(self.model, self.vehicle.thrust_rate_max, self.vehicle.body_radii, self.vehicle.mounts[self.camera])
        self._stages, self.compiled = compiled.load(stage_functions(stage))

    def problem(self, structure: Structure, phase: str) -> Problem:
        """The solver of a structure and phase; building one takes about 50 ms."""
        key = (structure, phase)
        if key not in self._problems:
            self._problems[key] = Problem(structure, self._stages, **PHASES[phase])
        return self._problems[key]

    def solve(self, structure: Structure, numbers: Numbers, pinned_end: np.ndarray, start_phase: str = "first") -> Solution:
        """All phases that a guess of this quality needs.

        Args:
            structure: which solver.
            numbers: the problem with the end weights of the first phase and no defects.
            pinned_end: end weights of the later phases, shape (6,).
            start_phase: "first" for a cold guess, "second" for the solution of a similar problem, "polish" for one that
                is right but for the integrator's error.

        Returns:
            The last phase's solution, with iterations and times of all; where the first phase diverges, its own.
        """
        iterations, time, cpu_time = 0, 0.0, 0.0
        if start_phase == "first":
            first = self.problem(structure, "sight" if structure.perception else "first").solve(numbers)
            iterations, time, cpu_time = first.iterations, first.time, first.cpu_time
            if not np.all(np.isfinite(first.states)):
                return first
            numbers = replace(numbers, states=first.states, inputs=first.inputs)
        last = self.problem(structure, "polish" if start_phase == "polish" else "second")
        defects = last.defects_of(numbers.states, numbers.inputs) if self.correct_drift else numbers.defects
        found = last.solve(replace(numbers, end_weights=pinned_end, defects=defects))
        return replace(found, iterations=iterations + found.iterations, time=time + found.time,
                       cpu_time=cpu_time + found.cpu_time)


def run_weights(weights: Weights, ramp: float, thrust_rate_max: float, intervals: int) -> np.ndarray:
    """Running weights for the stage functions, shape (4,).

    Sums over nodes grow with N; the weights are the authors' for N = 30 and are scaled to mean the same for every N.
    """
    share = 30.0 / intervals
    return np.array([weights.thrust * share, weights.rate * share, ramp or thrust_rate_max / (2 * intervals),
                     weights.rate_between * share])


def end_weights(weights: Weights) -> np.ndarray:
    """End weights for the stage functions, shape (6,)."""
    return np.array([weights.xy_end, weights.z_end, weights.tilt_end, weights.v_end, weights.w_end, weights.thrust_end])


def see_weights(weights: PerceptionWeights, intervals: int) -> np.ndarray:
    """Perception weights of every node with their exponential decay, shape (N, 3). [P:V-A]

    The camera cannot see the line at the end of the perch, so that neither the cost nor the constraints may rule there.
    """
    k = np.arange(intervals) * 30.0 / intervals
    soft = np.exp(-SOFT_DECAY * np.maximum(0.0, k - 30 * SOFT_UNTIL))
    cost = np.exp(-REPROJECTION_DECAY * k)
    return np.stack([weights.reprojection * cost, weights.cheirality * soft, weights.visibility * soft], axis=1) * 30.0 / intervals
