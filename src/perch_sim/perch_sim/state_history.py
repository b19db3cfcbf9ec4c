"""The true trajectory of the last moments, to be asked for any time in between: exposures end between two steps."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from perch_core import so3


class TrueState(NamedTuple):
    """True state of the vehicle."""

    time: int            # [ns]
    p_WB: np.ndarray     # (3,) [m]
    q_WB: np.ndarray     # xyzw, (4,)
    v_WB: np.ndarray     # (3,) [m/s]
    w_WB_B: np.ndarray   # (3,) [rad/s]


class StateHistory:
    """States at increasing times, as far back as a camera can ask."""

    def __init__(self, length: int) -> None:
        self._states: deque[TrueState] = deque(maxlen=length)

    def append(self, state: TrueState) -> None:
        """Add the newest state."""
        self._states.append(state)

    def at(self, time: int) -> TrueState:
        """State at a time [ns]: cubic Hermite in position, slerp in attitude.

        Raises:
            LookupError: the time lies outside the history.
        """
        states = self._states
        if not states or not states[0].time <= time <= states[-1].time:
            span = f"[{states[0].time}, {states[-1].time}]" if states else "an empty history"
            raise LookupError(f"time {time} ns is outside {span} ns")
        upper = len(states) - 1
        while upper > 1 and states[upper - 1].time >= time:
            upper -= 1
        if len(states) == 1:
            return states[0]
        a, b = states[upper - 1], states[upper]
        h = (b.time - a.time) * 1e-9
        s = (time - a.time) / (b.time - a.time)
        p = ((1 + 2 * s) * (1 - s) ** 2 * a.p_WB + s * s * (3 - 2 * s) * b.p_WB
             + h * s * (1 - s) * ((1 - s) * a.v_WB - s * b.v_WB))
        return TrueState(time, p, so3.quat_slerp(a.q_WB, b.q_WB, s), a.v_WB + s * (b.v_WB - a.v_WB),
                         a.w_WB_B + s * (b.w_WB_B - a.w_WB_B))
