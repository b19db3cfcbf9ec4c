"""Typed refusals of perching plans, with the violated constraint and its margin."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, hypot, sin, sqrt

from perch_core.arrays import Array
from perch_core.errors import PlanningRefusal
from perch_core.jit import compiled
from perch_core.values import Certificate
from perch_core.vector3 import norm
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.body_rate_bound import squared_rate
from perch_planner.clearance_bound import PLATE_SLACK
from perch_planner.problem import Limits, PerchProblem, PerchSettings

_HEADING_SINE_MIN = 1e-6  # of the angle between the thrust and b2_des, as in `perch_core.flatness`
_ROUNDING = 1e-6  # of a start that is a state of a plan at its limit
BAD_INPUT = "bad_input"
UNREACHABLE_TILT = "unreachable_tilt"
INFEASIBLE_WINDOW = "infeasible_window"
THRUST_FLOOR = "thrust_floor"
BOX = "box"
BODY_RATE = "body_rate"
SOLVER = "solver"


class PerchRefusal(PlanningRefusal):
    """Raised when there is no plan; carries the certificates of the last plan that was checked.

    Attributes:
        certificates: empty where no plan was checked.
        iterations: QPs solved.
        relaxed: values of settings that admit a plan; empty where none are known.
    """

    def __init__(self, code: str, constraint: str, margin: float, message: str, certificates: tuple[Certificate, ...] = (),
                 iterations: int = 0, relaxed: Mapping[str, float | str] | None = None) -> None:
        self.certificates, self.iterations, self.relaxed = certificates, iterations, dict(relaxed or {})
        super().__init__(code, constraint, margin, message)


@compiled
def _precheck_quantities(points: Array, a: Array, j: Array, yaw: float, yaw_rate: float, R_WS: Array, extension: float, offset: float,
                         moving: bool, low_height: float, high_height: float, nearest: float
                         ) -> tuple[float, float, float, float, float, int, float, int, float, float]:
    """Quantities of a plan that its start and its points determine.

    Args:
        points: start, waypoints and the surface's centre in W [m], shape (k, 3).
        a, j, yaw, yaw_rate: of the start [m/s^2, m/s^3, rad, rad/s].
        R_WS: axes of the surface, the last its outward normal.
        extension, offset: radius of the vehicle's disc, and distance of its centre from the surface at contact [m].
        moving: the height of the contact is unknown, as the target moves vertically.
        low_height, high_height, nearest: limits; the last is that of the distance of a waypoint from the surface's plane [m].

    Returns:
        (specific thrust of the start [m/s^2], sine of the angle between it and b2_des, its body rate [rad/s], reach of the rim
        towards the surface at the start [m], distance of the start from the surface's plane [m], first point whose height is out
        of range and that height [m], first waypoint too near to the plane and its distance [m], least path length to the contact
        [m]); points are -1 for none.
    """
    x, y, z = a[0], a[1], a[2] + GRAVITY
    specific, rate = sqrt(x * x + y * y + z * z), sqrt(squared_rate(x, y, z, j[0], j[1], j[2], yaw, yaw_rate))
    heading_sine = sqrt(z * z + (x * cos(yaw) + y * sin(yaw)) ** 2) / max(specific, 1e-9)
    cosine = min(abs(x * R_WS[0, 2] + y * R_WS[1, 2] + z * R_WS[2, 2]) / max(specific, 1e-9), 1.0)
    last, out_of_range, too_near = len(points) - 1, -1, -1
    start = height = distance = 0.0
    path_length = -abs(offset)
    for k in range(last + 1):
        z = points[k, 2] + (offset * R_WS[2, 2] if k == last else 0.0)
        if out_of_range < 0 and not (moving and k == last) and not low_height <= z <= high_height:
            out_of_range, height = k, z
        plane_distance = 0.0
        for d in range(3):
            plane_distance += R_WS[d, 2] * (points[k, d] - points[last, d])
        if k:
            path_length += norm((points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1], points[k, 2] - points[k - 1, 2]))
        if k == 0:
            start = plane_distance
        elif k < last and too_near < 0 and plane_distance <= nearest:
            too_near, distance = k, plane_distance
    return specific, heading_sine, rate, extension * sqrt(1.0 - cosine * cosine), start, out_of_range, height, too_near, distance, path_length


def check_feasibility(problem: PerchProblem, settings: PerchSettings, limits: Limits, vehicle: Vehicle) -> None:
    """Refuse problems that no trajectory can solve, before a QP is solved.

    Raises:
        PerchRefusal: the thrust limits are empty, the surface's attitude needs a thrust out of range [M:eq9, M:eq11], the
            vehicle cannot hover, start, waypoint or contact violate the box, the start violates thrust range or body rate,
            or the contact is too fast or too far away.
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
            f"the surface's attitude requires m alpha = {contact:.3f} N, outside [{low:.3f}, {high:.3f}] N; "
            f"choose impact_acceleration between {low / vehicle.mass:.2f} and {high / vehicle.mass:.2f} m/s^2")
    hover = vehicle.mass * GRAVITY
    if high <= 1.02 * hover:
        raise PerchRefusal(THRUST_FLOOR, "hover thrust m g below tau_max [M:eq16]", high - 1.02 * hover,
                           f"thrust_max {high:.3f} N leaves no reserve above the hover thrust {hover:.3f} N")
    start, surface = problem.start, problem.surface
    plate = limits.perch_offset + min(limits.clearance, 0.0) - PLATE_SLACK
    least = max(limits.clearance, plate)
    specific, heading_sine, rate, rim, distance, out_of_range, height, too_near, waypoint_distance, path_length = _precheck_quantities(
        problem.points, start.a, start.j, start.yaw, start.yaw_rate, surface.R_WS, limits.extension, vehicle.perch_offset, bool(problem.target_velocity[2]),
        *limits.height, least)
    specific *= vehicle.mass
    if not low <= specific <= high:
        raise PerchRefusal(BAD_INPUT, "thrust of the start state within [tau_min, tau_max] [M:eq16]",
                           min(specific - low, high - specific),
                           f"the start state requires {specific:.3f} N, outside [{low:.3f}, {high:.3f}] N")
    if heading_sine < _HEADING_SINE_MIN:
        raise PerchRefusal(BAD_INPUT, "heading of the start state [M:eq12]", heading_sine - _HEADING_SINE_MIN,
                           "the thrust of the start state points along b2_des = (-sin yaw, cos yaw, 0), where the yaw defines no attitude")
    if rate > (1.0 + _ROUNDING) * limits.body_rate:
        raise PerchRefusal(BODY_RATE, "body rate of the start state [M:eq13]", limits.body_rate - rate,
                           f"the body rate of the start state is {rate:.1f} rad/s, more than body_rate_max {limits.body_rate:g} rad/s")
    if out_of_range >= 0:
        margin = min(height - limits.height[0], limits.height[1] - height)
        name = ("start", *(f"waypoint {i}" for i in range(len(problem.waypoints))), "contact")[out_of_range]
        raise PerchRefusal(BOX, f"height of the {name}", margin,
                           f"{name} height {height:.3f} m is outside [{limits.height[0]:g}, {limits.height[1]:g}] m")
    speed, at_rest = hypot(*start.v.tolist()), not any(problem.target_velocity.tolist())
    if speed > limits.speed:
        raise PerchRefusal(BOX, "speed of the start state", limits.speed - speed,
                           f"the start speed {speed:.2f} m/s is above the limit {limits.speed:g} m/s")
    slowest = settings.impact_speed_min if at_rest else _least_contact_speed(problem, settings)
    if slowest > limits.speed:
        raise PerchRefusal(BOX, "speed at the contact", limits.speed - slowest,
                           f"the contact takes a speed of at least {slowest:.2f} m/s in W, more than speed_max {limits.speed:g} m/s")
    if path_length > limits.speed * settings.duration_max and at_rest:
        raise PerchRefusal(BOX, "speed_max and duration_max", limits.speed * settings.duration_max - path_length,
                           f"the path to the contact is {path_length:.1f} m, longer than speed_max {limits.speed:g} m/s covers in duration_max "
                           f"{settings.duration_max:g} s")
    if distance <= (needed := max(rim + limits.clearance, plate)):
        raise PerchRefusal(BOX, "clearance of the start from the surface's plane", distance - needed,
                           f"the start is {_describe_distance(distance)}; it needs more than {needed:.3f} m in front of it")
    if too_near >= 0 and at_rest:
        raise PerchRefusal(BOX, f"clearance of waypoint {too_near - 1} from the surface's plane", waypoint_distance - least,
                           f"waypoint {too_near - 1} is {_describe_distance(waypoint_distance)}; it needs more than {least:.3f} m in front of it")


def _least_contact_speed(problem: PerchProblem, settings: PerchSettings) -> float:
    """Least speed in W of a contact within the impact window [m/s]. [uses M:eq14]"""
    v, s3 = problem.target_velocity, problem.surface.normal
    pace = -float(v @ s3)  # of the surface along -s3
    slip = max(hypot(*(v + pace * s3).tolist()) - settings.tangential_speed_max, 0.0)
    return hypot(max(pace + settings.impact_speed_min, -pace - settings.impact_speed_max, 0.0), slip)


def _describe_distance(distance: float) -> str:
    """A signed distance from the surface's plane [m] in words."""
    return f"{abs(distance):.3f} m {'in front of' if distance >= 0.0 else 'behind'} the surface's plane"
