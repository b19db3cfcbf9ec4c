"""Levelling by body rates at large tilt: rotation about the horizontal axis that turns the body's z axis up by the shortest way.

Betaflight's self-level mode controls roll and pitch as Euler angles, which is not the shortest rotation beyond about 60 deg of
tilt. This law is proportional control of the reduced attitude (Bullo, Murray, Sarti, 1995): the direction up in B, which follows
from the firmware's Euler angles without a singularity.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, degrees, hypot, radians, sin

from perch_autopilot.rate_curve import CENTRE, HALF, RateCurve

GAIN = 10.0              # body rate / tilt, as that of self-level with `angle_p_gain = 100` [1/s]
TILT_THRESHOLD = 1.0     # tilt above which it levels by rates; below, self-level does [rad]
ATTITUDE_MAX_AGE = 0.05  # older attitudes are ignored [s]


def up(roll: float, pitch: float) -> tuple[float, float, float]:
    """Return the unit vector up in B (FLU), for roll and pitch of FRD against NED [rad]."""
    return sin(pitch), sin(roll) * cos(pitch), cos(roll) * cos(pitch)


def tilt(up_B: tuple[float, float, float]) -> float:
    """Return the angle between the body's z axis and up [rad]."""
    return atan2(hypot(up_B[0], up_B[1]), up_B[2])


def rates(up_B: tuple[float, float, float], rate_max: float) -> tuple[float, float]:
    """Return the rates about x and y in B (FLU) [rad/s], of norm up to `rate_max`, that turn z up; about x if z points down."""
    x, y, _ = up_B
    sine, rate = hypot(x, y), min(GAIN * tilt(up_B), rate_max)
    return (rate, 0.0) if sine < 1e-6 else (-rate * y / sine, rate * x / sine)


def sticks(up_B: tuple[float, float, float], curves: Sequence[RateCurve]) -> tuple[int, int]:
    """Return the pulse widths of roll and pitch [us] for `rates`."""
    both = rates(up_B, radians(min(curve.maximum for curve in curves)))
    roll, pitch = (round(CENTRE + HALF * curve.stick(degrees(rate))) for curve, rate in zip(curves, both))
    return roll, pitch
