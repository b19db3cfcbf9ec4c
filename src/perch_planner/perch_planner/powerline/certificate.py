"""Checks of a simulated plan: clearance, height, thrust, thrust rate and body rate between the nodes, errors at the end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perch_core import so3
from perch_core.lines import Segment, scaled_clearance
from perch_core.rotor_model import P, Q, THRUST, V, W
from perch_core.values import Certificate
from perch_core.vehicle import Vehicle
from perch_planner.powerline.request import PerchPose

ROUNDING = 1e-9  # relative to the limit: what floating point may add to a limit that is met exactly


def _certificate(quantity: str, unit: str, times: np.ndarray, values: np.ndarray, low: float = -np.inf, high: float = np.inf
                 ) -> Certificate:
    low_at, high_at = (np.unravel_index(pick(values), values.shape)[0] for pick in (np.argmin, np.argmax))
    least, most = float(values.min()), float(values.max())
    slack = ROUNDING * max(1.0, abs(low) if np.isfinite(low) else 0.0)
    return Certificate(
        quantity=quantity, unit=unit, lower_limit=float(low), upper_limit=float(high), minimum=least, maximum=most,
        time_of_minimum=float(times[low_at]), time_of_maximum=float(times[high_at]), method="dense",
        holds=bool(min(least - low, high - most) >= -slack))


def certify(vehicle: Vehicle, times: np.ndarray, states: np.ndarray, rates: np.ndarray, lines: Sequence[Segment],
            height_min: float, thrust_max: float) -> tuple[Certificate, ...]:
    """Certificates of all limits along a trajectory.

    Args:
        vehicle: limits and body.
        times: [s], shape (m,).
        states: shape (m, 17).
        rates: thrust rates [N/s], shape (m, 4).
        lines: every known segment, with the radius to be kept clear.
        height_min: [m].
        thrust_max: greatest rotor thrust that the plan may use [N].

    Returns:
        clearance (scaled distance minus 1, all lines), height, thrust, thrust_rate, body_rate.
    """
    nearest = np.full(len(times), np.inf)
    for line in lines:
        nearest = np.minimum(nearest, scaled_clearance(states[:, P], states[:, Q], line, vehicle.body_radii))
    found = [_certificate("clearance", "-", times, nearest, 0.0)] if len(lines) else []
    return (*found,
            _certificate("height", "m", times, states[:, 2], height_min),
            _certificate("thrust", "N", times, states[:, THRUST], vehicle.thrust_min, thrust_max),
            _certificate("thrust_rate", "N/s", times, np.abs(rates), -np.inf, vehicle.thrust_rate_max),
            _certificate("body_rate", "rad/s", times, np.linalg.norm(states[:, W], axis=1), -np.inf, vehicle.body_rate_max))


def certify_end(times: np.ndarray, states: np.ndarray, perch: PerchPose, position: float, tilt_deg: float, speed: float
                ) -> tuple[Certificate, ...]:
    """Certificates of the errors of the last state against the required pose.

    Args:
        times, states: as in `certify`.
        perch: required pose and velocity.
        position: greatest position error [m]; inf: any.
        tilt_deg: greatest angle between b3 and s3 [deg].
        speed: greatest velocity error [m/s].
    """
    last, b3_W = states[-1], so3.quat_to_matrix(states[-1, Q])[:, 2]
    errors = (
        ("end_position", "m", float(np.linalg.norm(last[P] - perch.p_WB)), position),
        ("end_tilt", "deg", float(np.degrees(so3.angle_between(b3_W, perch.s3_W))), tilt_deg),
        ("end_speed", "m/s", float(np.linalg.norm(last[V] - perch.v_W)), speed),
    )
    return tuple(_certificate(name, unit, times[-1:], np.array([error]), -np.inf, limit)
                 for name, unit, error, limit in errors if np.isfinite(limit))
