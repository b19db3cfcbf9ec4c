"""A perch with its recovery, or a recovery alone, for one vehicle. [P:V-B]"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from perch_core.errors import PlanningRefusal
from perch_core.rotor_model import P, Q, THRUST
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline.formulation import DEFAULT, Formulation
from perch_planner.powerline.nlp import Structure
from perch_planner.powerline.plan import PowerlinePlan
from perch_planner.powerline.relaxation import plan_perch
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.search import Search
from perch_planner.powerline.settings import PowerlineSettings
from perch_planner.powerline.solving import PHASES, Solver
from perch_planner.powerline.validation import check_request


@dataclass
class PowerlinePlanner:
    """Planner for one vehicle. Its construction loads the compiled functions, and compiles them the first time on a machine."""

    vehicle: Vehicle
    settings: PowerlineSettings = field(default_factory=PowerlineSettings)
    gravity: float = GRAVITY
    formulation: Formulation = DEFAULT
    solver: Solver = field(init=False)

    def __post_init__(self) -> None:
        self.settings.check(self.vehicle)
        self.solver = Solver(self.vehicle, self.gravity, self.settings.camera)

    def warm_up(self) -> None:
        """Build the solvers of the usual structures, with three lines, so that the first plan is as fast as later ones."""
        for perception, end in ((False, "perched"), (True, "perched"), (False, "hovering")):
            for phase in PHASES:
                if phase != "trial" and (perception or phase != "gauss_newton"):  # that one is never solved without perception costs
                    self.solver.problem(Structure(self.settings.intervals, 3, perception, end), phase)

    def plan(self, request: PowerlineRequest) -> PowerlinePlan:
        """Plan a perch with its recovery, or a recovery alone; where no recovery is found, `without_recovery` has the reason.

        Raises:
            PlanningRefusal: bad request, or no trajectory within the limits was found.
        """
        begin = perf_counter()
        pose = check_request(request, self.vehicle, self.settings)
        start = request.start.copy()  # a measured state has small errors: restore a unit quaternion, and thrusts within the range of the rotors
        start[Q] /= np.linalg.norm(start[Q])
        start[THRUST] = np.clip(start[THRUST], self.vehicle.thrust_min, self.vehicle.thrust_max)
        request = replace(request, start=start, deadline=request.deadline or self.settings.deadline)
        hover = start[P] if request.hover is None else np.asarray(request.hover, float)
        search = Search(self.vehicle, self.settings, self.formulation, self.solver)
        if pose is None:
            return PowerlinePlan(None, search.solve_and_check(search.recovery(request, hover)))
        perch = plan_perch(search, request, pose, begin + request.deadline)
        if not request.with_recovery:
            return PowerlinePlan(perch, None)
        try:
            rest = replace(request, start=perch.states[-1], deadline=begin + request.deadline - perf_counter())
            return PowerlinePlan(perch, search.solve_and_check(search.recovery(rest, hover)))
        except PlanningRefusal as refusal:
            return PowerlinePlan(perch, None, str(refusal))
