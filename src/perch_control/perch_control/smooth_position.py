"""Position from the integrated velocity around the contact with a wire: position corrections of the odometry are left out there.

VIO corrects its position by centimetres per image while the vehicle turns over. Neither the vehicle nor the last estimate of
the wire moves by that: a controller that followed the corrections would miss the wire by as much, and turn away from it to do
so. From `BEFORE` the contact on, when the mission stops shifting its plan with the map, the velocity is integrated from the
last position.
"""

from __future__ import annotations

from perch_control.admission import AtEnd, Order
from perch_core.vector3 import axpy, norm

BEFORE = 0.15     # begins so long before the contact; until then a mission moves its plan with the map [s]
AFTER = 0.25      # and corrections so long after it still are left out [s]
FARTHEST = 0.15   # odometry that is corrected by more was wrong altogether [m]
_ZERO = (0.0, 0.0, 0.0)


class SmoothPosition:
    """Owns the corrections that are left out on a trajectory to a wire; on other trajectories, the odometry is used unchanged."""

    def __init__(self) -> None:
        self._order: Order | None = None
        self._last: tuple[float, tuple[float, ...]] = (0.0, ())
        self._left_out = _ZERO

    def of(self, time: float, sample: tuple[float, ...], order: Order | None) -> tuple[float, ...]:
        """Return the state used for control.

        Args:
            time: stamp of the sample [s].
            sample: odometry: p_WB, v_WB (in W), q_WB (xyzw), w_WB_B, 13 floats.
            order: the tracked trajectory; None: there is none.
        """
        (before, last), self._last = self._last, (time, sample)
        if order is None or order.at_end is not AtEnd.RECOVER or order.recovery_start < 0.0:
            self._order = None
            return sample
        since = time - order.start - order.recovery_start
        if self._order is None or self._order.id != order.id:
            self._order, self._left_out = order, _ZERO
        elif -BEFORE < since < AFTER:
            dt = time - before
            moved = axpy(0.5 * dt, axpy(1.0, last[3:6], sample[3:6]), last[0:3])
            self._left_out = axpy(1.0, self._left_out, axpy(-1.0, moved, sample[0:3]))
            if norm(self._left_out) > FARTHEST:
                self._left_out = _ZERO
        return (*axpy(-1.0, self._left_out, sample[0:3]), *sample[3:])
