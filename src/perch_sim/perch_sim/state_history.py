"""Recent true trajectory, interpolated at any time in its span: exposures begin and end between two steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from perch_core import so3


class TrueState(NamedTuple):
    """True state of the vehicle."""

    time: int      # [ns]
    x: np.ndarray  # p_WB, q_WB, v_WB, w_WB_B, (13,): in one piece, as the plant makes it at every step

    @property
    def p_WB(self) -> np.ndarray:
        """Position, (3,) [m]."""
        return self.x[0:3]

    @property
    def q_WB(self) -> np.ndarray:
        """Attitude xyzw, (4,)."""
        return self.x[3:7]

    @property
    def v_WB(self) -> np.ndarray:
        """Velocity in W, (3,) [m/s]."""
        return self.x[7:10]

    @property
    def w_WB_B(self) -> np.ndarray:
        """Angular velocity in B, (3,) [rad/s]."""
        return self.x[10:13]


Bracket = tuple[TrueState, TrueState, float]
"""Two successive states, and the interpolation parameter 0..1 between them."""


class StateHistory:
    """States at increasing times, as far back as an exposure can reach."""

    def __init__(self, length: int) -> None:
        self._states: deque[TrueState] = deque(maxlen=length)

    @property
    def newest(self) -> int:
        """Time of the newest state [ns]; 0: no states."""
        return self._states[-1].time if self._states else 0

    def append(self, state: TrueState) -> None:
        """Add the newest state."""
        self._states.append(state)

    def at(self, time: int) -> TrueState:
        """Return the state at a time [ns]: cubic Hermite in position, slerp in attitude, linear in velocities.

        Raises:
            LookupError: the time lies outside the history.
        """
        a, b, s = self.bracket(time)
        p, q = between([(a, b, s)])
        return TrueState(time, np.concatenate([p[0], q[0], a.x[7:] + s * (b.x[7:] - a.x[7:])]))

    def bracket(self, time: int) -> Bracket:
        """Return the states before and after a time [ns], and the interpolation parameter 0..1 between them.

        Raises:
            LookupError: the time lies outside the history.
        """
        states = self._states
        if not states or not states[0].time <= time <= states[-1].time:
            span = f"[{states[0].time}, {states[-1].time}]" if states else "an empty history"
            raise LookupError(f"time {time} ns is outside {span} ns")
        if len(states) == 1:
            return states[0], states[0], 0.0
        upper = len(states) - 1
        while upper > 1 and states[upper - 1].time >= time:
            upper -= 1
        a, b = states[upper - 1], states[upper]
        return a, b, (time - a.time) / (b.time - a.time)


def between(brackets: Sequence[Bracket]) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (n, 3) and attitudes (n, 4) that are interpolated between states."""
    # The weights in plain floats: the same bits for one time and for many.
    weights = np.array([((1 + 2 * s) * (1 - s) ** 2, s * s * (3 - 2 * s), (b.time - a.time) * 1e-9 * s * (1 - s), 1 - s, s)
                        for a, b, s in brackets]).T[..., None]
    before, after = ([np.array([getattr(bracket[k], name) for bracket in brackets]) for name in ("p_WB", "v_WB", "q_WB")] for k in (0, 1))
    p = weights[0] * before[0] + weights[1] * after[0] + weights[2] * (weights[3] * before[1] - weights[4] * after[1])
    return p, so3.quat_slerp(before[2], after[2], weights[4, :, 0])
