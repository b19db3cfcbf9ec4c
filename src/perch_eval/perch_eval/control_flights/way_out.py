"""Search for a physically possible way out of a fault: extreme rotor commands, simulated on the plant from the time of the fault.

Over the tenth of a second that a vehicle near the floor has, rotor thrusts act on tilt and height almost linearly, so that
commands at the rotors' limits bound what can be reached. The search uses the true state without delay, as no controller can.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from perch_sim.plant import Plant
from perch_sim.timing import CONTROL_PERIOD

SWITCHES = (0.02, 0.04, 0.06, 0.09, 0.13)  # the second command may begin so long after the fault [s]
HORIZON = 0.4                              # a vehicle that has broken nothing so long after the fault is one that may get away [s]


@dataclass(frozen=True)
class Search:
    """Result of the search.

    Attributes:
        tried: number of sequences of rotor commands.
        survived: number of sequences without a crash within `HORIZON`; 0 or 1, as the search stops at the first.
        latest: longest time from the fault that any sequence was flown, up to its crash or `HORIZON` [s].
        turn_deg: bound on the turn of the vehicle within `latest`, relative to constant rotor speeds [deg].
    """

    tried: int
    survived: int
    latest: float
    turn_deg: float


def search(plant: Plant) -> Search:
    """Try every combination of rotors at their limits from the plant's present state, kept or changed once to any other.

    Args:
        plant: plant right after the fault; it is copied.
    """
    tried, latest, survived = 0, 0.0, False
    for periods, survived in _sequences(plant):
        tried, latest = tried + 1, max(latest, periods * CONTROL_PERIOD)
        if survived:
            break
    return Search(tried, int(survived), latest, _greatest_turn(plant, latest))


def _sequences(plant: Plant) -> Iterator[tuple[int, bool]]:
    """Yield (control periods flown, whether there was no crash) of every sequence of commands."""
    corners = [np.array(c) for c in itertools.product((plant.body.speed_min, plant.body.speed_max), repeat=4)]
    steps = round(HORIZON / CONTROL_PERIOD)
    switches = sorted(round(t / CONTROL_PERIOD) for t in SWITCHES)
    for first in corners:
        now, done = copy.deepcopy(plant), 0
        for switch in (*switches, steps):
            done += _advance(now, first, switch - done)
            if now.crashed or switch == steps:
                yield done, not now.crashed
                break
            for second in corners:
                if second is not first:
                    then = copy.deepcopy(now)
                    yield done + _advance(then, second, steps - done), not then.crashed


def _advance(plant: Plant, command: np.ndarray, steps: int) -> int:
    """Advance the plant with a constant command until it crashes; return the control periods flown."""
    for k in range(steps):
        plant.advance(command)
        if plant.crashed:
            return k + 1
    return steps


def _greatest_turn(plant: Plant, duration: float) -> float:
    """Return a bound on the turn from the rotors' lag and levers: each rotor goes to its farther limit, moments add up [deg]."""
    body, t = plant.body, np.linspace(0.0, duration, 200)[:, None]
    now = body.thrust_coefficient * plant.rotor_speed**2
    share = np.exp(-t / body.time_constant)
    reached = [body.thrust_coefficient * (limit + (plant.rotor_speed - limit) * share) ** 2 for limit in (body.speed_min, body.speed_max)]
    change = np.maximum(*(np.abs(thrust - now) for thrust in reached)) @ np.linalg.norm(body.rotor_xy, axis=1)
    rate = np.cumsum(change / min(body.inertia[:2])) * duration / len(t)
    return float(np.degrees(np.sum(rate) * duration / len(t)))
