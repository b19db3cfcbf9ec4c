"""Why there is no plan: typed, with the violated constraint and its margin."""

from __future__ import annotations

from math import hypot

from perch_core.errors import PlanningRefusal
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.certificates import Certificate
from perch_planner.problem import Limits, PerchProblem, PerchSettings

BAD_INPUT = "bad_input"
UNREACHABLE_TILT = "unreachable_tilt"
INFEASIBLE_WINDOW = "infeasible_window"
THRUST_FLOOR = "thrust_floor"
BOX = "box"
BODY_RATE = "body_rate"
SOLVER = "solver"
TIME_LIMIT = "time_limit"


class PerchRefusal(PlanningRefusal):
    """A refusal with the certificates of the best plan that was found on the way.

    Attributes:
        certificates: empty where no plan was found at all.
        iterations: QPs solved.
        limits: names of the limits without which there is a plan (`Limits.without`); empty where that is not known.
    """

    def __init__(self, code: str, constraint: str, margin: float, message: str, certificates: tuple[Certificate, ...] = (),
                 iterations: int = 0, limits: tuple[str, ...] = ()) -> None:
        self.certificates, self.iterations, self.limits = certificates, iterations, limits
        super().__init__(code, constraint, margin, message)


def _dot(a: list[float], b: list[float]) -> float:
    """Scalar product; on three plain numbers numpy's costs ten times as much."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def refuse_hopeless(problem: PerchProblem, settings: PerchSettings, limits: Limits, vehicle: Vehicle) -> None:
    """Refuse what no trajectory can do, before a QP is solved.

    Raises:
        PerchRefusal: the surface's attitude needs a thrust out of range [M:eq9, M:eq11], the vehicle cannot hover, the
            start or the contact break the box, or the start breaks the thrust range.
    """
    low, high = limits.thrust
    contact = vehicle.mass * settings.impact_acceleration
    if low > high:
        raise PerchRefusal(BAD_INPUT, "tau_min <= tau_max [M:eq16]", high - low,
                           f"thrust limits [{low:g}, {high:g}] N are empty")
    if not low < contact < high:
        margin = min(contact - low, high - contact)
        raise PerchRefusal(
            UNREACHABLE_TILT, "thrust at contact m alpha within [tau_min, tau_max] [M:eq9, M:eq11]", margin,
            f"holding the surface's attitude takes m alpha = {contact:.3f} N, outside [{low:.3f}, {high:.3f}] N; "
            f"choose impact_acceleration between {low / vehicle.mass:.2f} and {high / vehicle.mass:.2f} m/s^2",
            limits=("thrust",))
    hover = vehicle.mass * GRAVITY
    if high <= 1.02 * hover:
        raise PerchRefusal(THRUST_FLOOR, "hover thrust m g below tau_max [M:eq16]", high - 1.02 * hover,
                           f"thrust_max {high:.3f} N leaves nothing above the hover thrust {hover:.3f} N", limits=("thrust",))
    start, surface = problem.start, problem.surface
    f = start.a.tolist()
    f[2] += GRAVITY
    specific = vehicle.mass * hypot(*f)
    if not low <= specific <= high:
        raise PerchRefusal(BAD_INPUT, "thrust of the start state within [tau_min, tau_max] [M:eq16]",
                           min(specific - low, high - specific),
                           f"the start state already asks for {specific:.3f} N, outside [{low:.3f}, {high:.3f}] N",
                           limits=("thrust",))
    heights = {f"waypoint {k}": float(w.p[2]) for k, w in enumerate(problem.waypoints)}
    heights["start"] = float(start.p[2])
    if not problem.target_velocity[2]:
        heights["contact"] = float(surface.p_WS[2] + vehicle.perch_offset * surface.R_WS[2, 2])
    for name, height in heights.items():
        margin = min(height - limits.height[0], limits.height[1] - height)
        if margin < 0.0:
            raise PerchRefusal(BOX, f"height of the {name}", margin,
                               f"{name} height {height:.3f} m is outside [{limits.height[0]:g}, {limits.height[1]:g}] m",
                               limits=("height",))
    speed = hypot(*start.v.tolist())
    if speed > limits.speed:
        raise PerchRefusal(BOX, "speed of the start state", limits.speed - speed,
                           f"the start speed {speed:.2f} m/s is above the limit {limits.speed:g} m/s",
                           limits=("speed",))
    s3 = surface.normal.tolist()
    plane = _dot(surface.p_WS.tolist(), s3)
    lean = abs(_dot(f, s3)) * vehicle.mass / max(specific, 1e-9)
    rim = limits.extension * max(1.0 - min(lean, 1.0) ** 2, 0.0) ** 0.5
    distance = _dot(start.p.tolist(), s3) - plane
    if distance <= rim + limits.clearance:
        raise PerchRefusal(BOX, "clearance of the start from the surface's plane", distance - rim - limits.clearance,
                           f"the start is {distance:.3f} m in front of the surface's plane; the rim needs {rim:.3f} m",
                           limits=("clearance",))
    if problem.target_velocity.any():
        return
    for k, waypoint in enumerate(problem.waypoints):
        distance = _dot(waypoint.p.tolist(), s3) - plane
        if distance <= limits.clearance:
            raise PerchRefusal(BOX, f"clearance of waypoint {k} from the surface's plane", distance,
                               f"waypoint {k} is {-distance:.3f} m behind the surface's plane", limits=("clearance",))
