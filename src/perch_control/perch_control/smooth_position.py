"""Position from the integrated velocity around the contact with a wire: position corrections of the odometry are left out there.

VIO corrects its position by centimetres per image while the vehicle turns over. Neither the vehicle nor the last estimate of
the wire moves by that: a controller that followed the corrections would miss the wire by as much, and turn away from it to do
so. From `START_BEFORE_CONTACT` on, when the mission stops shifting its plan with the map, the velocity is integrated from the
last position.
"""

from __future__ import annotations

from perch_control.admission import AtEnd, Order
from perch_core.vector3 import axpy, norm

START_BEFORE_CONTACT = 0.15  # corrections are left out from so long before the contact, as the plan is not moved any more ... [s]
END_AFTER_CONTACT = 0.25     # ... until so long after it [s]
CORRECTION_MAX = 0.15        # odometry that is corrected by more was wrong altogether [m]
_ZERO = (0.0, 0.0, 0.0)


class SmoothPosition:
    """Owns the corrections that are left out on a trajectory to a wire; on other trajectories, the odometry is used unchanged."""

    def __init__(self) -> None:
        self._order: Order | None = None
        self._last: tuple[float, tuple[float, ...]] = (0.0, ())
        self._suppressed_correction = _ZERO

    def state(self, time: float, sample: tuple[float, ...], order: Order | None) -> tuple[float, ...]:
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
            self._order, self._suppressed_correction = order, _ZERO
        elif -START_BEFORE_CONTACT < since < END_AFTER_CONTACT:
            dt = time - before
            moved = axpy(0.5 * dt, axpy(1.0, last[3:6], sample[3:6]), last[0:3])
            self._suppressed_correction = axpy(1.0, self._suppressed_correction, axpy(-1.0, moved, sample[0:3]))
            if norm(self._suppressed_correction) > CORRECTION_MAX:
                self._suppressed_correction = _ZERO
        return (*axpy(-1.0, self._suppressed_correction, sample[0:3]), *sample[3:])
