"""Phases of a solve; with perception costs, a Gauss-Newton phase comes first.

Perception costs have negative curvature far from their minimum: with the exact Hessian, regularisation slows fatrop down to 30
to 80 iterations. Gauss-Newton comes near the minimum in a dozen but does not converge (it oscillates across the kinks of the soft
constraints). It is therefore stopped there, and the exact solve follows.

The end is constrained to a box, not by equalities: fatrop 1 does not terminate with eleven equalities at the last node.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from perch_core.rotor_model import RotorModel
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline import compiled
from perch_planner.powerline.formulation import Weights
from perch_planner.powerline.nlp import Problem, ProblemData, Solution, Structure
from perch_planner.powerline.settings import PerceptionWeights
from perch_planner.powerline.stage_functions import StageFunctions, StageModel, stage_functions

# Tolerance, first barrier parameter, push off active bounds: of a solve, of the approach to it with perception costs, and of
# one that starts from the solution of the same problem, which is right but for the integrator's error. A trial only searches for
# the limit that prevents a plan: a plan without that one is found soon, in 20 iterations or so.
PHASES: dict[str, dict[str, Any]] = {
    "gauss_newton": {"tolerance": 0.3, "max_iterations": 24, "gauss_newton": True},
    "solve": {"tolerance": 1e-3, "barrier": 1e-2, "max_iterations": 100},
    "trial": {"tolerance": 1e-3, "barrier": 1e-2, "max_iterations": 50},
    "refine": {"tolerance": 1e-3, "barrier": 1e-4, "push": 1e-4},
}
IPOPT_ITERATIONS = 300  # of IPOPT, which is tried last
END_SHARE = 0.2          # of the required accuracy at the end: the tolerance of the program there
MOMENT_TOLERANCE = 0.01  # of the moment at the end of a perch [N m]
RATE_TOLERANCE = 0.02    # of the body rate at the end [rad/s]
THRUST_TOLERANCE = 0.02  # of a rotor's thrust where a hover follows [N]

REPROJECTION_DECAY = 0.1  # of the cost [P:eq9], per thirtieth of the horizon
SOFT_DECAY = 0.3          # of the soft constraints [P:eq14h, P:eq14i], the same, from SOFT_UNTIL on
SOFT_UNTIL = 0.667        # share of the horizon


@dataclass
class Solver:
    """Solvers of one vehicle, built on first use and cached.

    Attributes:
        vehicle: body, limits, cameras.
        gravity: [m/s^2].
        camera: name of the camera of the perception costs.
    """

    vehicle: Vehicle
    gravity: float = GRAVITY
    camera: str = "front"
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
            options = PHASES[phase] | ({"max_iterations": IPOPT_ITERATIONS} if structure.solver == "ipopt" else {})
            self._problems[key] = Problem(structure, self._stages, **options)
        return self._problems[key]

    def solve(self, structure: Structure, data: ProblemData, start_phase: str = "gauss_newton") -> Solution:
        """Run all phases that a guess of this quality needs.

        Args:
            structure: selects the solver.
            data: the problem without defects.
            start_phase: "gauss_newton" for a cold guess, "trial" for a cold guess with fewer iterations, "solve" for the
                solution of a similar problem, "refine" for a guess that is right up to the integrator's error.

        Returns:
            The solution of the last phase, with iterations and times of all; that of the first phase where it diverges.
        """
        iterations, time, cpu_time = 0, 0.0, 0.0
        cold = start_phase in ("gauss_newton", "trial")
        gauss_newton = cold and structure.perception
        if gauss_newton:
            first = self.problem(structure, "gauss_newton").solve(data)
            iterations, time, cpu_time = first.iterations, first.time, first.cpu_time
            if not np.all(np.isfinite(first.states)):
                return first
            data = replace(data, states=first.states, inputs=first.inputs)
        last = self.problem(structure, "solve" if start_phase == "gauss_newton" else start_phase)
        if gauss_newton or not cold:
            data = replace(data, defects=last.defects_of(data.states, data.inputs))
        found = last.solve(data)
        return replace(found, iterations=iterations + found.iterations, time=time + found.time,
                       cpu_time=cpu_time + found.cpu_time)


def end_tolerances(end: str, position: float, tilt_deg: float, speed: float) -> np.ndarray:
    """Tolerances of the values of the stage function `perched`, `hovering` or none ("") that an accuracy permits."""
    turned, moving = [np.radians(tilt_deg)] * 2, [speed] * 3
    shares: list[float] = {"perched": [position] * 3 + turned + moving, "hovering": turned + moving, "": []}[end]
    rest = {"perched": [RATE_TOLERANCE] * 3 + [MOMENT_TOLERANCE] * 3, "hovering": [RATE_TOLERANCE] * 3 + [THRUST_TOLERANCE] * 4, "": []}[end]
    return np.array([*(END_SHARE * np.array(shares)), *rest])


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


def perception_weights(weights: PerceptionWeights, intervals: int) -> np.ndarray:
    """Perception weights of every node with their exponential decay, shape (N, 3). [P:V-A]

    The line is out of view at the end of the perch, so neither the cost nor the constraints may dominate there.
    """
    k = np.arange(intervals) * 30.0 / intervals
    soft = np.exp(-SOFT_DECAY * np.maximum(0.0, k - 30 * SOFT_UNTIL))
    cost = np.exp(-REPROJECTION_DECAY * k)
    return np.stack([weights.reprojection * cost, weights.cheirality * soft, weights.visibility * soft], axis=1) * 30.0 / intervals
