"""What a user may choose about powerline planning: weights, margins, durations, deadlines. Units in every field."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import choice, part, quantity, text
from perch_core.errors import ConfigError

DEADLINE_MAX = 10.0
"""No plan may take longer, whatever a request asks for [s]."""


@dataclass(frozen=True, kw_only=True)
class PerchWeights:
    """Cost weights of a perch [P:eq15]; the defaults are the authors'."""

    thrust: float = quantity(0.02, low=0.0, doc="rotor impulse")
    rate: float = quantity(0.3, low=0.0, doc="body rate at the nodes")
    rate_between: float = quantity(0.3, low=0.0, doc="body rate in the middle between the nodes; the authors have 0")
    xy_end: float = quantity(3000.0, low=0.0, doc="horizontal position at the end")
    z_end: float = quantity(3000.0, low=0.0, doc="height at the end")
    tilt_end: float = quantity(3000.0, low=0.0, doc="direction of b3 at the end")
    v_end: float = quantity(100.0, low=0.0, doc="velocity at the end")
    w_end: float = quantity(10.0, low=0.0, doc="body rate at the end")
    thrust_end: float = quantity(0.0, low=0.0, doc="rotor thrust at the end, against hover")


@dataclass(frozen=True, kw_only=True)
class RecoveryWeights(PerchWeights):
    """Cost weights of a recovery: upright and at rest matters, where it ends hardly."""

    thrust: float = quantity(0.08, low=0.0, doc="rotor impulse")
    xy_end: float = quantity(0.5, low=0.0, doc="horizontal position at the end")
    z_end: float = quantity(0.1, low=0.0, doc="height at the end")
    tilt_end: float = quantity(1000.0, low=0.0, doc="direction of b3 at the end")
    v_end: float = quantity(1000.0, low=0.0, doc="velocity at the end")
    thrust_end: float = quantity(10.0, low=0.0, doc="rotor thrust at the end, against hover, so that hover can follow")


@dataclass(frozen=True, kw_only=True)
class PerceptionWeights:
    """Weights of [P:eq9, P:eq14h, P:eq14i] and their exponential decay along the horizon."""

    reprojection: float = quantity(50.0, low=0.0, doc="line from the image centre, in focal lengths")
    cheirality: float = quantity(100.0, low=0.0, doc="soft constraint: the line is in front")
    visibility: float = quantity(100.0, low=0.0, doc="soft constraint: the segment is at the centre")
    reprojection_decay: float = quantity(0.1, low=0.0, doc="per thirtieth of the horizon")
    soft_decay: float = quantity(0.3, low=0.0, doc="per thirtieth of the horizon, from soft_until on")
    soft_until: float = quantity(0.667, low=0.0, high=1.0, doc="share of the horizon with full soft constraints")


@dataclass(frozen=True, kw_only=True)
class Margins:
    """By how much the nodes keep away from the limits, so that these hold between the nodes too.

    A plan whose 1 ms trajectory violates a limit is solved again with a larger N. [P:V-B]
    """

    height: float = quantity(0.05, unit="m", low=0.0, high=1.0)
    clearance: float = quantity(0.15, low=0.0, high=0.5, doc="(d^2 - 1) / (d^2 + 1) of the scaled distance d")
    leaving: float = quantity(0.2, low=0.0, high=0.6, doc="the same for a recovery, from a quarter of its time on")
    approaching: float = quantity(0.0, low=0.0, high=0.6, doc="the same for a perch, until a tenth of its time before the end; less than clearance: none")
    thrust: float = quantity(0.01, unit="N", low=0.0, high=5.0)
    body_rate: float = quantity(0.2, unit="rad/s", low=0.0, high=5.0)


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """What a finished plan must reach; a plan that does not is refused."""

    position: float = quantity(0.001, unit="m", above=0.0, doc="end of a perch")
    tilt_deg: float = quantity(0.1, unit="deg", above=0.0, doc="end of a perch and of a recovery")
    speed: float = quantity(0.02, unit="m/s", above=0.0, doc="end of a perch and of a recovery")


@dataclass(frozen=True, kw_only=True)
class PowerlineSettings:
    """Everything about a powerline plan that does not change from request to request."""

    intervals: int = quantity(30, low=10, high=120, doc="N of [P:eq14]")
    solver: str = choice("fatrop", options=("fatrop", "ipopt"), doc="first choice; ipopt is the fallback")
    height_min: float = quantity(0.8, unit="m", low=-1000.0, high=1000.0, doc="z_min of [P:eq14e]")
    duration: tuple[float, float] = quantity((0.05, 5.0), unit="s", above=0.0, high=30.0, doc="bounds of T, perch")
    recovery_duration: tuple[float, float] = quantity((0.5, 2.0), unit="s", above=0.0, high=30.0, doc="bounds of T, recovery")
    thrust_share: float = quantity(0.95, above=0.0, high=1.0, doc="share of a rotor's greatest thrust that a plan may use")
    end_factor: float = quantity(300.0, low=1.0, high=1e5, doc="end weights of the second phase over those of the first")
    ramp: float = quantity(0.0, low=0.0, high=10.0, doc="input in the impulse of [P:eq15]; 0: as the equation says")
    correct_drift: bool = quantity(True, doc="remove the integrator's error; false: the authors' discretisation as it is")
    perch: PerchWeights = part(PerchWeights)
    recovery: RecoveryWeights = part(RecoveryWeights)
    perception: PerceptionWeights = part(PerceptionWeights)
    margins: Margins = part(Margins)
    accuracy: Accuracy = part(Accuracy)
    bearing_max_deg: float = quantity(120.0, unit="deg", above=0.0, high=180.0,
                                      doc="a perch point farther from the camera's heading counts as behind the vehicle")
    gripper_error_max: float = quantity(0.05, unit="m", above=0.0, doc="a given perch pose must bring the gripper this near to the line")
    deadline: float = quantity(2.0, unit="s", above=0.0, high=DEADLINE_MAX, doc="wall-clock limit of a plan")
    camera: str = text("front", doc="camera that keeps the line in view")

    def __post_init__(self) -> None:
        for key in ("duration", "recovery_duration"):
            low, high = getattr(self, key)
            if not low < high:
                raise ConfigError("", key, f"[{low:g}, {high:g}] s is not an interval")
