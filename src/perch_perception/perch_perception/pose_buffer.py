"""Short history of the estimator's states, interpolated at a stamp.

Images arrive 20-30 ms after their exposure. At 3 m/s that is 9 cm, so an image's result must be combined with the pose at its
exposure, never with the pose at its arrival.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from perch_core import so3
from perch_core.errors import PerchError
from perch_core.values import limits

SLOW = 1.0  # speed up to which the odometry's position is smoother than the integral of its velocity [m/s]
_COVARIANCE = limits.Covariance(6)  # at 500 Hz its variances alone are looked at
SPAN = 1.0  # how much history is kept [s]
MAX_GAP = 0.05  # states further apart than this are not interpolated [s]
JUMP, JUMP_WITHIN = 0.15, 0.1  # odometry that moves by so much more than its velocity explains, within so long, has jumped [m, s]
PAUSE = 0.3  # after a jump, corrections count in full for so long; across a longer pause of the odometry, none count [s]


class StampError(PerchError):
    """Raised when there is no state at a stamp: it is too old, too new or in a gap, or the state's covariance is invalid."""


@dataclass(frozen=True)
class BodyState:
    """State of the body at a time.

    Attributes:
        time: [s].
        p_WB: position [m], shape (3,).
        q_WB: attitude, xyzw, shape (4,).
        v_WB: velocity in W [m/s], shape (3,).
        w_WB_B: angular velocity in B [rad/s], shape (3,).
        covariance: of position and attitude, errors in the axes of W [m, rad], shape (6, 6).
        corrected: sum of the odometry's position corrections at speed and of its jumps since the beginning, i.e. of displacement
            that its velocity does not explain, in W [m], shape (3,). `p_WB - corrected` is as smooth as the vehicle's motion.
    """

    time: float
    p_WB: np.ndarray
    q_WB: np.ndarray
    v_WB: np.ndarray
    w_WB_B: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    corrected: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def R_WB(self) -> np.ndarray:
        """Attitude as a matrix, shape (3, 3)."""
        return so3.quat_to_matrix(self.q_WB)


class PoseBuffer:
    """The states of the last `SPAN` seconds, by time."""

    def __init__(self) -> None:
        self._states: deque[BodyState] = deque()
        self._times: deque[float] = deque()
        self._corrected: deque[np.ndarray] = deque()
        self._uncounted: deque[tuple[float, np.ndarray]] = deque()  # time, unexplained displacement that is not in `corrected`
        self._last_jump = -np.inf  # [s]

    def __len__(self) -> int:
        return len(self._states)

    @property
    def newest(self) -> float:
        """Time of the newest state [s]; -inf where there is none."""
        return self._times[-1] if self._times else -np.inf

    def add(self, state: BodyState) -> bool:
        """Append a state. Return False, and ignore it, where it is not newer than the last or not finite."""
        if self._times and state.time <= self._times[-1]:
            return False
        squares = sum(x @ x for x in (state.p_WB, state.q_WB, state.v_WB, state.w_WB_B))
        if not math.isfinite(state.time + squares):  # one check: this runs at 500 Hz
            return False
        self._corrected.append(self._correction(state))
        self._states.append(state)
        self._times.append(state.time)
        while self._times[-1] - self._times[0] > SPAN:
            self._times.popleft()
            self._states.popleft()
            self._corrected.popleft()
        return True

    def with_twist(self, state: BodyState) -> BodyState:
        """Return a state of a source that has no twist with that of its pose's change since the newest; zero before the second.

        Jumps of such a source count as motion.
        """
        dt = state.time - self.newest
        if not 0.0 < dt < np.inf:
            return state
        before = self._states[-1]
        turn = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(before.q_WB), state.q_WB))
        return replace(state, v_WB=(state.p_WB - before.p_WB) / dt, w_WB_B=turn / dt)

    def at(self, time: float) -> BodyState:
        """Return the state at a time [s].

        Raises:
            StampError: no states yet, older than the history, newer than the newest state, in a gap, or an invalid covariance.
        """
        state = self._at(time)
        if problem := _COVARIANCE.problem(state.covariance):
            raise StampError(f"stamp {time:.4f} s: the odometry's covariance {problem}")
        return state

    def _at(self, time: float) -> BodyState:
        if not self._times:
            raise StampError("no odometry yet")
        newest, oldest = self._times[-1], self._times[0]
        if time > newest:
            raise StampError(f"stamp {time:.4f} s is {1e3 * (time - newest):.1f} ms ahead of the odometry")
        if time < oldest:
            raise StampError(f"stamp {time:.4f} s is {1e3 * (oldest - time):.1f} ms older than the stored odometry")
        right = bisect_left(self._times, time)
        if self._times[right] == time:
            return replace(self._states[right], corrected=self._corrected[right])
        a, b = self._states[right - 1], self._states[right]
        if b.time - a.time > MAX_GAP:
            raise StampError(f"stamp {time:.4f} s lies in a gap of {1e3 * (b.time - a.time):.0f} ms of the odometry")
        share, before = (time - a.time) / (b.time - a.time), self._corrected[right - 1]
        return replace(_between(a, b, share), corrected=before + share * (self._corrected[right] - before))

    def _correction(self, state: BodyState) -> np.ndarray:
        """Return `corrected` for a state that follows the newest.

        A jump counts in full, whether one sample has it or several. Smaller corrections count above the speed `SLOW`, in full from
        twice that speed, and not across a gap. In a hover vision holds the position, and the velocity's error of some cm/s would
        accumulate.
        """
        window = self._uncounted
        if not self._states or state.time - self._times[-1] >= PAUSE:
            window.clear()
            window.append((state.time, np.zeros(3)))
            return self._corrected[-1] if self._states else np.zeros(3)
        before, dt = self._states[-1], state.time - self._times[-1]
        unexplained = state.p_WB - before.p_WB - (0.5 * dt) * (before.v_WB + state.v_WB)
        while len(window) > 1 and window[1][0] <= state.time - JUMP_WITHIN:
            window.popleft()
        uncounted = window[-1][1] + unexplained
        recent = uncounted - window[0][1]
        if math.sqrt(recent @ recent) > JUMP:
            counted, self._last_jump = recent, state.time
            window.clear()  # what led to the jump is counted
        elif state.time - self._last_jump < PAUSE:
            counted = unexplained
        else:
            share = 0.0 if dt > MAX_GAP else min(max(math.sqrt(state.v_WB @ state.v_WB) / SLOW - 1.0, 0.0), 1.0)
            counted = share * unexplained
        window.append((state.time, uncounted - counted))
        return self._corrected[-1] + counted


def _between(a: BodyState, b: BodyState, share: float) -> BodyState:
    return BodyState(
        time=a.time + share * (b.time - a.time),
        p_WB=a.p_WB + share * (b.p_WB - a.p_WB),
        q_WB=so3.quat_slerp(a.q_WB, b.q_WB, share),
        v_WB=a.v_WB + share * (b.v_WB - a.v_WB),
        w_WB_B=a.w_WB_B + share * (b.w_WB_B - a.w_WB_B),
        covariance=a.covariance + share * (b.covariance - a.covariance),
    )
