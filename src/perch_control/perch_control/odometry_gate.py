"""Which odometry may be flown on: in time order, and where the last one said the vehicle would be."""

from __future__ import annotations

from math import acos, degrees, radians, sqrt
from typing import NamedTuple

import numpy as np

from perch_core.covariance import largest_sigma
from perch_core.jit import compiled


_POSITION_JUMP = 0.25  # largest step between two samples beyond the motion: above a correction of VIO [m]
_VELOCITY_JUMP = 1.5   # the same of the velocity, beyond what 4 g change in between [m/s]
_ATTITUDE_JUMP = 20.0  # the same of the attitude beyond the rotation [deg]
_CONFIRM = 0.03        # a jump that stays so long, and is as certain as what was before it to within these steps, is the new truth [s]


class Verdict(NamedTuple):
    """`usable`: fly on it. `jumped`: the first sample accepted after a jump. `reason`: why not, or what happened."""

    usable: bool
    jumped: bool = False
    reason: str = ""


class OdometryGate:
    """Owns the last accepted sample and a candidate that jumped away from it."""

    def __init__(self) -> None:
        self.stamp: float | None = None     # of the last accepted sample [s]
        self.state: tuple[float, ...] = ()
        self._covariances: tuple[np.ndarray, np.ndarray] | None = None  # of the last accepted sample
        self._candidate: tuple[float, float, tuple[float, ...]] | None = None  # first stamp, last stamp, state

    def check(self, stamp: float, state: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None = None) -> Verdict:
        """Judge one sample whose values are within their limits.

        Args:
            stamp: [s].
            state: p_WB, v_WB, q_WB (xyzw), w_WB_B, 13 floats.
            covariances: of pose and twist as in `OdometryState`, shapes (6, 6); None: nothing is said, a jump is believed.
        """
        if self.stamp is None:
            return self._accept(stamp, state, covariances)
        if stamp <= self.stamp:
            return Verdict(False, reason=f"odometry stamp {stamp:.3f} s is not after {self.stamp:.3f} s")
        problem = self._step(self.stamp, self.state, stamp, state)
        if not problem:
            return self._accept(stamp, state, covariances)
        if self._candidate is None or self._step(self._candidate[1], self._candidate[2], stamp, state):
            self._candidate = (stamp, stamp, state)
        self._candidate = (self._candidate[0], stamp, state)
        if stamp - self._candidate[0] >= _CONFIRM:
            if doubt := self._doubt(covariances):
                return Verdict(False, reason=f"{problem}, {doubt}")
            return self._accept(stamp, state, covariances, problem)
        return Verdict(False, reason=problem)

    def _accept(self, stamp: float, state: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None, jump: str = "") -> Verdict:
        self.stamp, self.state, self._covariances, self._candidate = stamp, state, covariances, None
        return Verdict(True, bool(jump), jump)

    def _doubt(self, covariances: tuple[np.ndarray, np.ndarray] | None) -> str:
        """What the odometry itself no longer knows where it has jumped to; empty: it is there.

        The covariance that has been added since the last accepted sample counts, as VIO's own grows without end: a step as large as the
        1 sigma that comes with it is no measurement of one.
        """
        if covariances is None:
            return ""
        before = self._covariances or (np.zeros((6, 6)),) * 2
        parts = [("position", "m", 0, slice(0, 3), _POSITION_JUMP), ("attitude", "rad", 0, slice(3, 6), radians(_ATTITUDE_JUMP))]
        if covariances[1][0, 0] >= 0.0 and before[1][0, 0] >= 0.0:
            parts.append(("velocity", "m/s", 1, slice(0, 3), _VELOCITY_JUMP))
        for name, unit, k, s, limit in parts:
            sigma = largest_sigma((covariances[k] - before[k])[s, s])
            if sigma > limit:
                return f"and its {name} is less certain by {sigma:.2g} {unit}"
        return ""

    def _step(self, t0: float, a: tuple[float, ...], t1: float, b: tuple[float, ...]) -> str:
        """What is wrong with the step from one sample to the next; empty: nothing."""
        dt = t1 - t0
        dp, dv, turn, spun = _changes(a, b, dt)
        if dp > _POSITION_JUMP:
            return f"odometry position jumped by {dp:.2f} m in {dt * 1e3:.0f} ms"
        if dv > _VELOCITY_JUMP + 40.0 * dt:
            return f"odometry velocity jumped by {dv:.2f} m/s in {dt * 1e3:.0f} ms"
        if degrees(turn - spun) > _ATTITUDE_JUMP:
            return f"odometry attitude jumped by {degrees(turn):.0f} deg in {dt * 1e3:.0f} ms"
        return ""


@compiled
def _changes(a, b, dt):
    """From state a to state b (13 floats), `dt` [s] later: what of the position the velocities leave unexplained [m], the velocity's
    change [m/s], the turn, and how far the body rates go in that time [rad]."""
    dp, dv, c, wa, wb = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        dp += (b[i] - a[i] - 0.5 * dt * (a[3 + i] + b[3 + i])) ** 2
        dv += (b[3 + i] - a[3 + i]) ** 2
        wa += a[10 + i] ** 2
        wb += b[10 + i] ** 2
    for i in range(6, 10):
        c += a[i] * b[i]
    return sqrt(dp), sqrt(dv), 2.0 * acos(min(abs(c), 1.0)), dt * sqrt(max(wa, wb))
