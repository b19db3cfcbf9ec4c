"""Gate for odometry: a sample must be in time order and consistent with the motion of the last accepted one."""

from __future__ import annotations

from math import acos, degrees, radians, sqrt
from typing import NamedTuple

import numpy as np

from perch_core.covariance import largest_sigma
from perch_core.jit import compiled
from perch_core.vector3 import axes_of, dot


_POSITION_JUMP = 0.25  # largest step between two samples beyond the motion: above a correction of VIO [m]
_VELOCITY_JUMP = 1.5   # the same of the velocity, beyond what 4 g change in between [m/s]
_ATTITUDE_JUMP = 20.0  # the same of the attitude beyond the rotation [deg]
_CONFIRM = 0.03        # a jump that lasts so long is accepted, in flight if the uncertainty has grown by less than these limits [s]


class Verdict(NamedTuple):
    """Verdict on a sample: whether it is `usable` for control, whether it `jumped` (the first one accepted after a jump), and the
    `reason` of a refusal or the accepted jump."""

    usable: bool
    jumped: bool = False
    reason: str = ""


class OdometryGate:
    """Owns the last accepted sample, and a candidate that has jumped away from it."""

    def __init__(self) -> None:
        self.stamp: float | None = None     # of the last accepted sample [s]
        self.state: tuple[float, ...] = ()
        self._covariances: tuple[np.ndarray, np.ndarray] | None = None  # of the last accepted sample
        self._candidate: tuple[float, float, tuple[float, ...]] | None = None  # first stamp, last stamp, state

    def check(self, stamp: float, state: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None = None,
              flying: bool = False) -> Verdict:
        """Judge one sample whose values are within their limits.

        Args:
            stamp: [s].
            state: p_WB, v_WB, q_WB (xyzw), w_WB_B, 13 floats.
            covariances: of pose and twist as in `OdometryState`, shapes (6, 6); None: unknown, they prevent no jump.
            flying: whether the vehicle flies: a jump to an uncertain state, or of b3, is not accepted then, however long it lasts. The
                attitude before it was flown on, and no correction of VIO changes the direction of gravity. At rest, odometry may
                begin anew anywhere.
        """
        if self.stamp is None:
            return self._accept(stamp, state, covariances)
        if stamp <= self.stamp:
            return Verdict(False, reason=f"odometry stamp {stamp:.3f} s is not after {self.stamp:.3f} s")
        problem = self._jump_reason(self.stamp, self.state, stamp, state)
        if not problem:
            return self._accept(stamp, state, covariances)
        if self._candidate is None or self._jump_reason(self._candidate[1], self._candidate[2], stamp, state):
            self._candidate = (stamp, stamp, state)
        self._candidate = (self._candidate[0], stamp, state)
        if stamp - self._candidate[0] >= _CONFIRM:
            if flying and (doubt := self._uncertain_part(covariances) or self._tilt_change(stamp, state)):
                return Verdict(False, reason=f"{problem}, {doubt}")
            return self._accept(stamp, state, covariances, problem)
        return Verdict(False, reason=problem)

    def _accept(self, stamp: float, state: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None, jump: str = "") -> Verdict:
        self.stamp, self.state, self._covariances, self._candidate = stamp, state, covariances, None
        return Verdict(True, bool(jump), jump)

    def _uncertain_part(self, covariances: tuple[np.ndarray, np.ndarray] | None) -> str:
        """Return which part of the state is too uncertain after a jump for the jump to be accepted; empty: none.

        Only the covariance added since the last accepted sample counts, as that of VIO grows without bound. Where its 1 sigma
        exceeds the limit of a jump, the new state is not a confirmed one.
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

    def _tilt_change(self, stamp: float, state: tuple[float, ...]) -> str:
        """Return that b3 has turned since the last accepted sample by more than the body rates explain; empty: it has not."""
        assert self.stamp is not None
        *_, spun = _changes(self.state, state, stamp - self.stamp)
        turn = acos(min(max(dot(axes_of(self.state[6:10])[2], axes_of(state[6:10])[2]), -1.0), 1.0))
        return f"and its tilt by {degrees(turn):.0f} deg" if degrees(turn - spun) > _ATTITUDE_JUMP else ""

    def _jump_reason(self, t0: float, a: tuple[float, ...], t1: float, b: tuple[float, ...]) -> str:
        """Return why the step from one sample to another is a jump; empty: it is none."""
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
    """Changes from state a to state b (13 floats), `dt` [s] later: the position change beyond that of the velocities [m], the
    velocity change [m/s], the angle of the rotation, and the angle that the body rates explain [rad]."""
    dp, dv, c, wa, wb = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        dp += (b[i] - a[i] - 0.5 * dt * (a[3 + i] + b[3 + i])) ** 2
        dv += (b[3 + i] - a[3 + i]) ** 2
        wa += a[10 + i] ** 2
        wb += b[10 + i] ** 2
    for i in range(6, 10):
        c += a[i] * b[i]
    return sqrt(dp), sqrt(dv), 2.0 * acos(min(abs(c), 1.0)), dt * sqrt(max(wa, wb))
