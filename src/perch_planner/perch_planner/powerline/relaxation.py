"""Limits of a perch, to be taken away one at a time where the solver finds none: what a caller can change first, then the vehicle's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from perch_core.vehicle import Vehicle
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

FASTER = 2.0  # of the rotors, without the range of their thrust; thrust grows with the square

_Problem = tuple[PowerlineRequest, PowerlineSettings, Vehicle]


class Relaxation(NamedTuple):
    """A limit, and a problem without it.

    Attributes:
        words: for messages.
        constraint: of a refusal because of it.
        relaxed: request, settings and vehicle to those without the limit.
    """

    words: str
    constraint: str
    relaxed: Callable[[PowerlineRequest, PowerlineSettings, Vehicle], _Problem]


RELAXATIONS = (
    Relaxation("height limit", "height [P:eq14e]", lambda r, s, v: (r, replace(s, height_min=-1000.0), v)),
    Relaxation("limit of the duration", "duration [P:eq14c]", lambda r, s, v: (r, replace(s, duration=(s.duration[0], 30.0)), v)),
    Relaxation("other lines", "clearance [P:eq14j]", lambda r, s, v: (replace(r, lines=(r.target(),)), s, v)),
    Relaxation("thrust range of the rotors", "rotor thrust [P:eq14f]",
               lambda r, s, v: (r, s, replace(v, speed_min=0.0, speed_max=FASTER * v.speed_max))),
    Relaxation("body-rate limit", "body rate", lambda r, s, v: (r, s, replace(v, body_rate_max=1e3))),
)
