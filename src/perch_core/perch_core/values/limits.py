"""Limits of values that enter components: sizes, counts and magnitudes, and the format in which other values are refused.

The bounds lie far outside what any supported vehicle measures or flies, so values beyond them are invalid for every receiver: a
component refuses them on input (`perch_core.component`), a planner answers BAD_INPUT, the mission BAD_GOAL. What depends on the
current state (stamps, frames, position) or on the vehicle is checked by the receiver. docs/limits.md is generated from this file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import hypot, inf, isfinite, pi
from typing import Any

import numpy as np

from perch_core.camera import IMAGE_SIZE_MIN, EquidistantCamera, PinholeCamera, RadialTangentialCamera
from perch_core.errors import ConfigError
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values.flight import (
    AttitudeThrust, ControllerCommand, ControllerStatus, MotorCommand, RatesThrust, SetControllerRequest, TrajectoryOrder)
from perch_core.values.mission import PerchGoal
from perch_core.values.perching import MappedPowerline, PowerlineMap, TargetPose
from perch_core.values.planning import PerchPlanRequest, PowerlinePlanRequest
from perch_core.values.sensing import CameraImage, CameraModel, ImuSample, Transform
from perch_core.values.stamps import NANOSECONDS
from perch_core.values.state import EstimatorHealth, InertialState, OdometryState, RotorState

_QUOTED_MAX = 60  # characters of a refused text that are quoted


@dataclass(frozen=True)
class Limit:
    """Range of a number, or of every entry of an array; NaN is outside.

    Attributes:
        low, high: inclusive.
        unit: of the values.
        shape: shape of the array; (): a number; -1: any size, along the first axis up to `rows_max`.
        rows_max: greatest number of rows.
        optional: NaN is allowed and leaves the choice to the receiver.
    """

    low: float
    high: float
    unit: str = ""
    shape: tuple[int, ...] = ()
    rows_max: int = 0
    optional: bool = False

    def problem(self, value: Any) -> str:
        """Return why a value is refused; empty: it is valid."""
        numbers = value if self.shape else (value,)
        fits = type(numbers) is tuple and self.shape in ((), (len(numbers),))
        if fits and all(type(x) is float and self.low <= x <= self.high for x in numbers):
            return ""  # numpy takes ten times as long for a few floats
        try:
            array = np.asarray(value, float)
        except (TypeError, ValueError, OverflowError):
            return "is not made of numbers"
        if array.ndim == 1 and array.shape == self.shape and all(self.low <= x <= self.high for x in array.tolist()):
            return ""
        many = self.shape[:1] == (-1,)
        if many and len(array.shape) and not array.size:
            return ""
        if array.ndim != len(self.shape) or any(n not in (-1, given) for n, given in zip(self.shape, array.shape)):
            required = " x ".join("n" if n < 0 else str(n) for n in self.shape) or "one"
            return f"shape {array.shape} is not {required}"
        if many and len(array) > self.rows_max:
            return f"{len(array)} entries are more than {self.rows_max}"
        inside = (array >= self.low) & (array <= self.high) | (np.isnan(array) if self.optional else False)
        if np.all(inside):
            return ""
        shown = float(array[~inside].flat[0])
        return f"{shown:g} is outside {self}" if isfinite(shown) or self.optional else f"{shown:g} is not finite"

    def __str__(self) -> str:
        low, high = (f"{end:.0f}" if float(end).is_integer() else f"{end:g}" for end in (self.low, self.high))
        return f"[{low}, {high}] {self.unit}".rstrip()


@dataclass(frozen=True)
class Unit:
    """A unit quaternion, within a tolerance for rounding."""

    tolerance: float = 1e-3

    def problem(self, value: Any) -> str:
        """Return why a value is refused; empty: it is valid."""
        norm = float(np.sqrt(sum(float(x) * float(x) for x in value)))
        return "" if len(value) == 4 and abs(norm - 1.0) <= self.tolerance else f"norm {norm:.4f} is not 1"

    def __str__(self) -> str:
        return f"norm 1 within {self.tolerance:g}"


@dataclass(frozen=True)
class Covariance:
    """A covariance matrix; `semidefinite`: symmetric and positive semi-definite; otherwise only its variances are checked.

    Attributes:
        absent: a negative first entry is allowed and means that there is no covariance.
    """

    size: int
    semidefinite: bool = True
    absent: bool = False

    def problem(self, value: Any) -> str:
        """Return why a value is refused; empty: it is valid."""
        C = np.asarray(value, float)
        if C.size != self.size**2:
            return f"{C.size} entries are not {self.size} x {self.size}"
        C = C.reshape(self.size, self.size)
        scale = float(np.abs(C).max())
        if not scale <= VARIANCE_MAX:
            return f"an entry of {scale:g} is " + (f"beyond {VARIANCE_MAX:g}" if isfinite(scale) else "not finite")
        if self.absent and C[0, 0] < 0.0:
            return ""
        if C.diagonal().min() < 0.0:
            return f"a variance of {C.diagonal().min():g} is negative"
        if self.semidefinite and (np.abs(C - C.T).max() > 1e-5 * scale + 1e-15 or np.linalg.eigvalsh(C)[0] < -1e-6 * scale - 1e-15):
            return "is not symmetric and positive semi-definite"
        return ""

    def __str__(self) -> str:
        kind = "symmetric, positive semi-definite" if self.semidefinite else "no negative variance"
        return f"{self.size} x {self.size}, {kind}, entries up to {VARIANCE_MAX:g}"


@dataclass(frozen=True)
class Text:
    """Text of up to `length_max` characters."""

    length_max: int

    def problem(self, value: Any) -> str:
        """Return why a value is refused; empty: it is valid."""
        return "" if len(value) <= self.length_max else f"{value[:_QUOTED_MAX]!r}...: {len(value)} characters are more than {self.length_max}"

    def __str__(self) -> str:
        return f"up to {self.length_max} characters"


@dataclass(frozen=True)
class Each:
    """Several values of one type, each within its own limits."""

    kind: type
    count_max: int

    def problem(self, value: Any) -> str:
        """Return why a value is refused; empty: it is valid."""
        if len(value) > self.count_max:
            return f"{len(value)} entries are more than {self.count_max}"
        return next((f"[{k}].{reason}" for k, one in enumerate(value) if (reason := problem(one))), "")

    def __str__(self) -> str:
        return f"up to {self.count_max}, each a {self.kind.__name__}"


@dataclass(frozen=True)
class Part:
    """A value of another type, within that type's limits; None is allowed."""

    kinds: tuple[type, ...]

    def problem(self, value: Any) -> str:
        """Return why a value is refused; empty: it is valid."""
        return "" if value is None else problem(value)

    def __str__(self) -> str:
        return "a " + " or ".join(kind.__name__ for kind in self.kinds)


def _vector(size: float, unit: str) -> Limit:
    return Limit(-size, size, unit, (3,))


def _rows(size: float, unit: str, width: int, rows_max: int) -> Limit:
    return Limit(-size, size, unit, (-1, width), rows_max)


def _coefficients(segments: int) -> Limit:
    return Limit(-1e4, 1e4, "m or rad", (-1, 4, -1), segments)


VARIANCE_MAX = 1e8  # a larger variance carries no information, and its square could overflow
SEGMENTS_MAX, DEGREE_MAX, SAMPLES_MAX = 1000, 20, 5000  # of a trajectory: 5 s at a sample per ms, 20 s at what the planner gives
PLAN_DURATION_MAX, PLAN_SEGMENTS_MAX = 600.0, 101  # of what is planned on [s]
PLAN_LINES_MAX = 100

STAMP = Limit(0, (2**31 - 1) * NANOSECONDS, "ns")
POSITION, VELOCITY, ACCELERATION = _vector(1e4, "m"), _vector(100.0, "m/s"), _vector(1e3, "m/s^2")
ANGULAR_VELOCITY = _vector(100.0, "rad/s")  # gyroscopes end at 70 rad/s (4000 deg/s)
_SPECIFIC_THRUST = Limit(0.0, 1e3, "m/s^2")
TILT = Limit(0.0, pi + 1e-6, "rad")  # pi may be rounded, as in 3.1415927
FRAME = Text(256)
ID = Limit(0, 2**32 - 1)
_PIXELS = Limit(1, 1e4, "px")
_FOCAL, _CENTRE = Limit(1.0, 1e5, "px"), Limit(-1e5, 1e5, "px")
_SIDE = Limit(IMAGE_SIZE_MIN, 1e4, "px")
_CAMERA = {"width": _SIDE, "height": _SIDE, "fx": _FOCAL, "fy": _FOCAL, "cx": _CENTRE, "cy": _CENTRE}
_DISTORTED = {**_CAMERA, "coefficients": Limit(-1e3, 1e3, "", (-1,), 8)}

LIMITS: dict[type, dict[str, Any]] = {
    ImuSample: {"w_B": ANGULAR_VELOCITY, "f_B": _vector(2000.0, "m/s^2"), "frame": FRAME},  # accelerometers end at 2000 m/s^2 (200 g)
    CameraImage: {"width": _PIXELS, "height": _PIXELS, "frame": FRAME},
    CameraModel: {"frame": FRAME, "camera": Part((PinholeCamera, RadialTangentialCamera, EquidistantCamera))},
    PinholeCamera: _CAMERA, RadialTangentialCamera: _DISTORTED, EquidistantCamera: _DISTORTED,
    Transform: {"parent": FRAME, "child": FRAME, "p": POSITION, "q": Unit(1e-2)},  # written by hand
    OdometryState: {
        "p_WB": POSITION, "q_WB": Unit(), "v_B": VELOCITY, "w_B": ANGULAR_VELOCITY, "pose_covariance": Covariance(6, semidefinite=False),
        "twist_covariance": Covariance(6, semidefinite=False, absent=True), "frame": FRAME},
    InertialState: {
        "p_WB": POSITION, "q_WB": Unit(), "v_WB": VELOCITY, "gyro_bias": _vector(10.0, "rad/s"), "accel_bias": _vector(100.0, "m/s^2"),
        "covariance": Covariance(15), "frame": FRAME},
    EstimatorHealth: {"state": Limit(0, 3), "vio_age": Limit(-1.0, inf, "s")},
    ControllerStatus: {"state": Limit(0, 7), "trajectory_id": ID, "trajectory_time": Limit(-3600.0, 1e6, "s"), "thrust_ratio": Limit(0.0, 2.0, "")},
    TargetPose: {"stamp": STAMP, "p_WS": POSITION, "q_WS": Unit(), "covariance": Covariance(6)},
    MappedPowerline: {
        "id": ID, "start": POSITION, "end": POSITION, "radius": Limit(1e-4, 1.0, "m"), "covariance": Covariance(3),
        "direction_sigma": Limit(0.0, inf, "rad")},
    PowerlineMap: {"stamp": STAMP, "lines": Each(MappedPowerline, 500)},
    MotorCommand: {"rotor_speed": Limit(0.0, 1e4, "rad/s", (4,))},
    RotorState: {"speed": Limit(-1e4, 1e4, "rad/s", (4,)), "thrust": Limit(-1e3, 1e3, "N", (4,))},
    RatesThrust: {"w_B": ANGULAR_VELOCITY, "thrust": _SPECIFIC_THRUST},
    AttitudeThrust: {"q_WB": Unit(), "w_B": ANGULAR_VELOCITY, "thrust": _SPECIFIC_THRUST},
    ControllerCommand: {"command": Limit(0, 5)},
    TrajectoryOrder: {
        "id": ID, "at_end": Limit(0, 3), "contact_time": Limit(0.0, 60.0, "s"), "recovery_start": Limit(-inf, 3600.0, "s"),
        "trajectory": Part((FlatTrajectory, SampledTrajectory))},
    FlatTrajectory: {
        "start_time": Limit(0.0, 2.0**31, "s"), "duration": Limit(0.0, 3600.0, "s"), "degree": Limit(0, DEGREE_MAX),
        "durations": Limit(1e-6, 3600.0, "s", (-1,), SEGMENTS_MAX), "coefficients": _coefficients(SEGMENTS_MAX)},
    SampledTrajectory: {
        "start_time": Limit(0.0, 2.0**31, "s"), "times": Limit(0.0, 3600.0, "s", (-1,), SAMPLES_MAX),
        "p": _rows(1e4, "m", 3, SAMPLES_MAX), "v": _rows(100.0, "m/s", 3, SAMPLES_MAX), "a": _rows(1e3, "m/s^2", 3, SAMPLES_MAX),
        "q": _rows(1.1, "", 4, SAMPLES_MAX), "w": _rows(100.0, "rad/s", 3, SAMPLES_MAX), "dw": _rows(1e5, "rad/s^2", 3, SAMPLES_MAX),
        "rotor_thrust": _rows(1e3, "N", 4, SAMPLES_MAX)},
    SetControllerRequest: {"type": Text(100)},
    PerchGoal: {
        "takeoff_height": Limit(0.3, 10.0, "m", optional=True), "search_frame": FRAME, "search_position": POSITION, "search_attitude": Unit(),
        "search_timeout": Limit(1e-3, 300.0, "s", optional=True), "inclination_hint": replace(TILT, optional=True),
        "perch_point": POSITION, "perch_pitch": TILT, "attempts": Limit(0, 100)},
    PerchPlanRequest: {
        "start": STAMP, "p": POSITION, "v": VELOCITY, "a": ACCELERATION, "j": _vector(1e5, "m/s^3"), "yaw": Limit(-1e3, 1e3, "rad"),
        "yaw_rate": Limit(-100.0, 100.0, "rad/s"), "p_WS": POSITION, "q_WS": Unit(), "target_velocity": VELOCITY,
        "waypoints": Limit(-1e4, 1e4, "m", (-1, 3), 50), "segment_times": Limit(0.01, PLAN_DURATION_MAX, "s", (-1,), 51),
        "impact_acceleration": Limit(0.0, 100.0, "m/s^2"), "impact_speed_min": Limit(0.0, 20.0, "m/s"),
        "impact_speed_max": Limit(0.0, 20.0, "m/s"), "thrust_max": Limit(0.01, 1e3, "N"), "thrust_min": Limit(0.0, 1e3, "N"),
        "thrust_ratio": Limit(0.0, 2.0, ""), "objective": Limit(0, 4)},
    PowerlinePlanRequest: {
        "start": STAMP, "p": POSITION, "q": Unit(1e-2), "v": VELOCITY, "w": ANGULAR_VELOCITY, "rotor_thrust": Limit(0.0, 1e3, "N", (-1,), 4),
        "lines": Each(MappedPowerline, PLAN_LINES_MAX), "target_line": ID, "perch_point": POSITION, "perch_pitch": TILT,
        "end_velocity": VELOCITY, "deadline": Limit(0.0, 1e12, "s")},
}
"""Limits by type of value and field; fields that are None are not checked."""

STATE = {name: LIMITS[PerchPlanRequest][name] for name in ("p", "v", "a", "j", "yaw", "yaw_rate")}
CURRENT = {"durations": Limit(1e-3, PLAN_DURATION_MAX, "s", (-1,), PLAN_SEGMENTS_MAX), "degree": Limit(0, DEGREE_MAX),
           "coefficients": _coefficients(PLAN_SEGMENTS_MAX)}
"""Limits of `PerchPlanRequest.current`; its state at `start` must be within `STATE`."""
POSE: dict[str, Limit | Unit] = {"position": POSITION, "orientation": Unit(1e-2)}
"""Limits of `PowerlinePlanRequest.perch_pose`."""


def problem(value: Any) -> str:
    """Return why a value is invalid, as `field: reason`; empty: valid, or no limits for its type. Runs at every IMU sample."""
    global _last_valid
    if value is _last_valid:
        return ""
    kind = type(value)
    try:
        if kind in _FAST_CHECKS and _FAST_CHECKS[kind](value):
            _last_valid = value
            return ""
    except (AttributeError, IndexError, TypeError, ValueError):  # of other sizes or kinds
        pass
    for name, limit in LIMITS.get(kind, {}).items():
        if (entry := getattr(value, name)) is not None and (reason := limit.problem(entry)):
            return f"{name}{reason}" if reason[0] == "[" else f"{name}: {reason}"
    return ""


_last_valid: Any = None  # that passed a fast check: the other receivers in its process take the same object


def check(source: str, values: Any, limits: dict[str, Any] | None = None) -> None:
    """Check a value against its limits.

    Args:
        source: for messages.
        values: an object with one attribute per limit.
        limits: name -> limit; None: the limits of the type of `values`.

    Raises:
        ConfigError: a field is invalid; names the field, its value and what is allowed.
    """
    for name, limit in (LIMITS[type(values)] if limits is None else limits).items():
        value = getattr(values, name)
        if value is not None and (reason := limit.problem(value)):
            raise ConfigError(source, name, reason) if reason[0] != "[" else ConfigError(source, *f"{name}{reason}".split(": ", 1))


def stamp_of(request: Any) -> int:
    """Return the start of a request as a stamp for diagnostics [ns], 0 if it is not a valid stamp."""
    return 0 if STAMP.problem(request.start) else int(request.start)


def _imu(sample: ImuSample) -> bool:
    (a, b, c), (x, y, z) = sample.w_B, sample.f_B
    return a * a + b * b + c * c < 1e4 and x * x + y * y + z * z < 4e6 and len(sample.frame) < 256


def _odometry(state: OdometryState) -> bool:
    x, y, z, w = state.q_WB
    return (abs(x * x + y * y + z * z + w * w - 1.0) < 1e-3 and _below(state.p_WB, 1e8) and _below(state.v_B, 1e4)
            and _below(state.w_B, 1e4) and len(state.frame) < 256 and _variances(state.pose_covariance) and _variances(state.twist_covariance))


def _off(command: MotorCommand | RatesThrust | AttitudeThrust) -> bool:
    """Return whether the motors are to stop: nothing else of the command counts."""
    return not command.armed


def _motors(command: MotorCommand) -> bool:
    if _off(command):
        return True
    a, b, c, d = command.rotor_speed
    return 0.0 <= a <= 1e4 and 0.0 <= b <= 1e4 and 0.0 <= c <= 1e4 and 0.0 <= d <= 1e4


def _below(v: tuple[float, ...], square: float) -> bool:
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2] < square


def _variances(covariance: np.ndarray) -> bool:
    entries = covariance.ravel().tolist()
    return len(entries) == 36 and hypot(*entries) < VARIANCE_MAX and min(entries[::7]) >= 0.0


_FAST_CHECKS: dict[type, Callable[[Any], bool]] = {
    ImuSample: _imu, OdometryState: _odometry, MotorCommand: _motors, RatesThrust: _off, AttitudeThrust: _off}
"""Fast checks, 1 to 2 us each, by type; where one does not accept a value, `LIMITS` decides."""
