"""Ways out of a perch: abort trajectories from a state in motion to a hover in front of the surface, with proved limits.

A way out ends at rest at the end point of a minimum-snap stop from the start, kept away from surface, floor and ceiling.
It is short, so durations are not searched for: three are tried, first without and then with an early knot, since a vehicle that
is already tilted to the surface has to turn back at once.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from perch_core.config import replace
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import Vehicle
from perch_planner import refusals
from perch_planner.certificates import certificates
from perch_planner.contact_constraints import TUBE_FLOOR, TUBE_SHARE, TUBE_STEP, Contact
from perch_planner.plan_checks import CLEARANCE, HOLDS
from perch_planner.planner import PerchPlan
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.search import Outcome, Search

DURATIONS = (1.2, 0.8, 1.8)  # [s]
TURN_TIME = 0.3              # of the first piece, where the vehicle turns back [s]
STANDOFF_MIN = 0.5           # least distance of the hover from the surface's plane when it is reached [m]
_THROUGH_SURFACE = -1e3      # clearance without which the surface limits no way out [m]
_CODES = {"body_rate": refusals.BODY_RATE, "thrust": refusals.THRUST_FLOOR, "rotor_thrust": refusals.THRUST_FLOOR}


class _Hover(Contact):
    """End conditions of a hover at a place [m]: at rest, without impact window and tube."""

    def __init__(self, problem: PerchProblem, settings: PerchSettings, place: np.ndarray) -> None:
        start = problem.start
        self.velocity, self.points = np.zeros(3), np.array([start.p, place])
        self.problem = (self.points, start.v, start.a, start.j, np.ones(3, np.int64), np.arange(1, 4), np.zeros((3, 3)), problem.surface.R_WS,
                        self.velocity, settings.impact_acceleration, TUBE_SHARE, TUBE_FLOOR, 0.0, TUBE_STEP, 0.0, -np.inf, np.inf, np.inf)


def hover_place(problem: PerchProblem, limits: Limits, duration: float) -> np.ndarray:
    """Position at which a way out ends [m], shape (3,).

    The velocity of a minimum-snap stop is the quintic from the start's v, a and j to rest; its integral is the first term.
    """
    start, surface = problem.start, problem.surface
    place = start.p + duration * (start.v / 2.0 + duration * (start.a / 10.0 + duration * start.j / 120.0))
    standoff = float((place - surface.p_WS - duration * problem.target_velocity) @ surface.normal)
    place = place + max(STANDOFF_MIN - standoff, 0.0) * surface.normal
    place[2] = min(max(place[2], limits.height[0] + limits.extension), limits.height[1])
    return place


def plan_way_out(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> PerchPlan:
    """Plan a way out.

    Args:
        problem: start and surface.
        settings: parameters of the planner; the jerk is minimised.
        vehicle: mass, thrust range and extension.

    Returns:
        A plan that keeps every limit, each with its proof.

    Raises:
        PerchRefusal: no way out was found; carries a limit that the last checked one violates.
    """
    begin, limits = perf_counter(), Limits.of(settings, vehicle)
    search = Search(problem, replace(settings, objective="jerk"), vehicle, limits)
    found = _found(search)
    if found is None or not found.proved:
        raise _refusal(found, search)
    trajectory = FlatTrajectory(found.durations, np.concatenate([found.coefficients, found.yaw[:, None]], axis=1))
    return PerchPlan(trajectory, certificates(found.results, limits, vehicle.mass), search.iterations, perf_counter() - begin,
                     tuple(search.attempts))


def _found(search: Search) -> Outcome | None:
    """Return the first stop whose limits are proved; where there is none, the last one that was checked."""
    best: Outcome | None = None
    for durations in [(T,) for T in DURATIONS] + [(TURN_TIME, T - TURN_TIME) for T in DURATIONS]:
        search.contact = _Hover(search.problem, search.settings, hover_place(search.problem, search.limits, sum(durations)))
        outcome = search.try_durations(np.array(durations))
        if outcome.proved:
            return outcome
        best = outcome if best is None or len(outcome.results) else best
    return best


def _refusal(best: Outcome | None, search: Search) -> PerchRefusal:
    """Return the refusal of a way out: the surface where there is one without it, otherwise a limit that the last checked stop violates."""
    settings, limits, mass = replace(search.settings, clearance_min=_THROUGH_SURFACE), search.limits, search.vehicle.mass
    through = _found(Search(search.problem, settings, search.vehicle, Limits.of(settings, search.vehicle)))
    if through is not None and through.proved:
        through.results[CLEARANCE, HOLDS] = 0.0
        best = through
    if best is None or not len(best.results):
        return PerchRefusal(refusals.THRUST_FLOOR, "thrust range [M:eq16]", -np.inf, "no way out: no stop keeps the thrust within its range",
                            iterations=search.iterations)
    proofs = certificates(best.results, limits, mass)
    broken = next(proof for proof in proofs if not proof.holds)
    return PerchRefusal(_CODES.get(broken.quantity, refusals.BOX), broken.quantity, broken.margin, f"no way out: {broken}", proofs, search.iterations)
