"""What a request to a planner may hold: shapes, counts and magnitudes, declared once and checked before anything is solved.

They bound what the planners are asked to look at, far outside what any vehicle flies; what cannot be flown is refused by the
planners themselves, with the limit that forbids it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from perch_core.errors import ConfigError
from perch_core.values import NANOSECONDS

LONGEST = 600.0  # no plan is longer [s]


class Limit(NamedTuple):
    """Range of a number, or of every entry of an array.

    Attributes:
        low, high: inclusive.
        unit: of the values.
        shape: of the array, () a number; -1: any number of rows up to `most`.
        most: rows.
    """

    low: float
    high: float
    unit: str = ""
    shape: tuple[int, ...] = ()
    most: int = 0


def _vector(size: float, unit: str) -> Limit:
    return Limit(-size, size, unit, (3,))


START = Limit(0, (2**31 - 1) * NANOSECONDS, "ns")
POSITION, VELOCITY = _vector(1e4, "m"), _vector(100.0, "m/s")
QUATERNION = Limit(-1.01, 1.01, "", (4,))

PERCH_PLAN = {
    "start": START, "p": POSITION, "v": VELOCITY, "a": _vector(1e3, "m/s^2"), "j": _vector(1e5, "m/s^3"),
    "yaw": Limit(-1e3, 1e3, "rad"), "yaw_rate": Limit(-100.0, 100.0, "rad/s"), "p_WS": POSITION, "q_WS": QUATERNION,
    "target_velocity": VELOCITY, "waypoints": Limit(-1e4, 1e4, "m", (-1, 3), 50),
    "segment_times": Limit(0.01, LONGEST, "s", (-1,), 51), "impact_acceleration": Limit(0.0, 100.0, "m/s^2"),
    "impact_speed_min": Limit(0.0, 20.0, "m/s"), "impact_speed_max": Limit(0.0, 20.0, "m/s"), "thrust_max": Limit(0.0, 1e3, "N"),
    "thrust_min": Limit(0.0, 1e3, "N"), "objective": Limit(0, 4),
}
"""Of `PerchPlanRequest`; None is left to the planner."""

CURRENT = {"durations": Limit(1e-3, LONGEST, "s", (-1,), 101)}
"""Of the polynomials of `PerchPlanRequest.current`, whose state at the start is limited as one that is given."""
STATE = {name: PERCH_PLAN[name] for name in ("p", "v", "a", "j", "yaw", "yaw_rate")}
DEGREE = 20
"""Their greatest degree."""

POWERLINE_PLAN = {
    "start": START, "p": POSITION, "q": QUATERNION, "v": VELOCITY, "w": _vector(100.0, "rad/s"),
    "rotor_thrust": Limit(0.0, 1e3, "N", (-1,), 4), "target_line": Limit(0, 2**32 - 1), "perch_point": POSITION,
    "perch_pitch": Limit(0.0, 3.1415926545897932, "rad"), "end_velocity": VELOCITY, "deadline": Limit(0.0, np.inf, "s"),
}
"""Of `PowerlinePlanRequest`."""

LINES_MAX = 100
LINE = {"id": Limit(0, 2**32 - 1), "start": POSITION, "end": POSITION, "radius": Limit(1e-4, 1.0, "m")}
"""Of each of its lines."""

POSE = (POSITION, QUATERNION)
"""Of its `perch_pose`."""


def stamp_of(request: Any) -> int:
    """The start of a request as a stamp for diagnostics [ns], 0 where it is none."""
    return int(request.start) if START.low <= request.start <= START.high else 0


def check(source: str, values: Any, limits: dict[str, Limit]) -> None:
    """Refuse values outside their limits.

    Args:
        source: for messages.
        values: an object with an attribute for each limit.
        limits: name -> limit.

    Raises:
        ConfigError: names the field, its value and the range.
    """
    for name, limit in limits.items():
        value = getattr(values, name)
        if value is not None:
            check_value(source, name, value, limit)


def check_value(source: str, name: str, value: Any, limit: Limit) -> None:
    """Refuse one value outside its limit.

    Raises:
        ConfigError: names the field, its value and the range.
    """
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(source, name, "is not made of numbers") from None
    many = limit.shape[:1] == (-1,)
    if many and len(array.shape) and not array.size:
        return
    if array.ndim != len(limit.shape) or array.shape[many:] != limit.shape[many:]:
        wanted = " x ".join("n" if n < 0 else str(n) for n in limit.shape) or "one"
        raise ConfigError(source, name, f"shape {array.shape} is not {wanted}")
    if many and len(array) > limit.most:
        raise ConfigError(source, name, f"{len(array)} entries are more than {limit.most}")
    finite = np.isfinite(array)
    if not finite.all():
        raise ConfigError(source, name, f"{_shown(array[~finite])} is not finite")
    outside = (array < limit.low) | (array > limit.high)
    if outside.any():
        raise ConfigError(source, name, f"{_shown(array[outside])} is outside [{limit.low:g}, {limit.high:g}] {limit.unit}".rstrip())


def _shown(numbers: np.ndarray) -> str:
    return f"{float(np.ravel(numbers)[0]):g}"
