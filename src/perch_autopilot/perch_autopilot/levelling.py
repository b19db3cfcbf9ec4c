"""Levelling by body rates where a body is tilted far: the rate is about the horizontal axis that turns its z axis up the shortest way.

Betaflight's self-level steers roll and pitch by Euler angles, which is no shortest way beyond about 60 deg of tilt. This law is the
proportional control of the reduced attitude (Bullo, Murray, Sarti, 1995): the direction up in B, which the firmware's Euler angles give
without a singularity.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, degrees, hypot, radians, sin

from perch_autopilot.rate_curve import CENTRE, HALF, RateCurve

GAIN = 10.0   # body rate / tilt, as that of self-level with `angle_p_gain = 100` [1/s]
FAR = 1.0     # tilt above which it levels by rates; below, self-level does [rad]
FRESH = 0.05  # an attitude that is older does not count [s]


def up(roll: float, pitch: float) -> tuple[float, float, float]:
    """Unit vector up in B (FLU) at roll and pitch of FRD against NED [rad]."""
    return sin(pitch), sin(roll) * cos(pitch), cos(roll) * cos(pitch)


def tilt(up_B: tuple[float, float, float]) -> float:
    """Angle between the body's z axis and up [rad]."""
    return atan2(hypot(up_B[0], up_B[1]), up_B[2])


def rates(up_B: tuple[float, float, float], most: float) -> tuple[float, float]:
    """Body rates about x and y in B (FLU) [rad/s], together at most `most`, that turn z to up; about x where it points straight down."""
    x, y, _ = up_B
    sine, rate = hypot(x, y), min(GAIN * tilt(up_B), most)
    return (rate, 0.0) if sine < 1e-6 else (-rate * y / sine, rate * x / sine)


def sticks(up_B: tuple[float, float, float], curves: Sequence[RateCurve]) -> tuple[int, int]:
    """Pulse widths of roll and pitch [us] for `rates`."""
    both = rates(up_B, radians(min(curve.most for curve in curves)))
    roll, pitch = (round(CENTRE + HALF * curve.stick(degrees(rate))) for curve, rate in zip(curves, both))
    return roll, pitch
