"""What the outputs of a component must be, whatever it was given: finite, normalised, certain, within what the vehicle can do."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterator
from typing import Any

import numpy as np

from perch_core.values import EstimatorHealth, MotorCommand, PerchFeedback, PerchResult
from perch_core.values.planning import Certificate

LARGEST = 1e9
LONGEST_TEXT = 5000
MAY_BE_ABSENT = {PerchFeedback: {"time_to_contact"}, PerchResult: {"contact_time"}, EstimatorHealth: {"vio_age", "nis", "position_sigma", "attitude_sigma"},
                 Certificate: {"lower_limit", "upper_limit", "minimum", "maximum", "time_of_minimum", "time_of_maximum"}}
"""Fields that are NaN or infinite where there is nothing to tell."""


def nonsense(value: Any, speed_max: float, place: str = "", turned: float = 1e-6) -> Iterator[str]:
    """What is wrong with a value that a component has emitted.

    Args:
        value: as emitted.
        speed_max: greatest rotor speed of the vehicle [rad/s].
        place: of it, for words.
        turned: how far the norm of a quaternion may be from 1.
    """
    if isinstance(value, np.ndarray):
        if value.dtype == object or not np.isfinite(value).all():
            yield f"{place}: not finite"
        elif "covariance" in place.rpartition(".")[2]:
            yield from _covariance(value, place)
        elif _is_attitude(place) and value.shape[-1:] == (4,) and np.abs(np.linalg.norm(value, axis=-1) - 1.0).max() > turned:
            yield f"{place}: norm {np.linalg.norm(value, axis=-1)} is not 1"
    elif isinstance(value, (bool, enum.Enum)) or value is None:
        return
    elif isinstance(value, float):
        if not abs(value) < LARGEST:
            yield f"{place}: {value}"
    elif isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            yield f"{place}: {len(value)} characters"
    elif hasattr(value, "_fields") or dataclasses.is_dataclass(value):
        names = value._fields if hasattr(value, "_fields") else [item.name for item in dataclasses.fields(value) if item.init]
        for name in names:
            if name not in MAY_BE_ABSENT.get(type(value), ()):
                yield from nonsense(getattr(value, name), speed_max, f"{place}.{name}", turned)
        if isinstance(value, MotorCommand) and not all(0.0 <= speed <= 1.001 * speed_max for speed in value.rotor_speed):
            yield f"{place}: rotor speeds {value.rotor_speed} are outside [0, {speed_max:.0f}]"
    elif isinstance(value, (tuple, list)):
        if _is_attitude(place) and len(value) == 4 and all(isinstance(x, float) for x in value):
            yield from nonsense(np.array(value), speed_max, place, turned)
        else:
            for entry in value:
                yield from nonsense(entry, speed_max, place, turned)


def _is_attitude(place: str) -> bool:
    name = place.rpartition(".")[2]
    return name in ("q", "q_WB", "q_WS", "q_WC", "final_attitude")


def _covariance(C: np.ndarray, place: str) -> Iterator[str]:
    if C[0, 0] < 0.0:  # there is none
        return
    scale = np.abs(C).max() + 1e-12
    if np.abs(C - C.T).max() > 1e-6 * scale or np.linalg.eigvalsh(C)[0] < -1e-6 * scale:
        yield f"{place}: not symmetric and positive semi-definite"


def same(a: Any, b: Any) -> bool:
    """Whether two outputs are the same to the last bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, item.name), getattr(b, item.name)) for item in dataclasses.fields(a) if item.init)
    return bool(a == b) or (isinstance(a, float) and a != a and b != b)
