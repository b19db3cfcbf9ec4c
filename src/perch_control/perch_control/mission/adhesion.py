"""Detection of adhesion, from the IMU and the estimated state alone."""

from __future__ import annotations

from collections import deque

import numpy as np

from perch_core import so3
from perch_core.vehicle import GRAVITY
from perch_control.mission.values import State, Target
from perch_control.period import NOMINAL_PERIOD

WINDOW = 0.06  # time over which the specific force is averaged [s]
IMBALANCE_MAX = 3.0  # largest difference between the mean specific force and gravity of a body at rest [m/s^2]
SPEED = 0.5  # of a vehicle at rest, as estimated [m/s]
TILT = np.radians(25.0)  # between b3 and the surface normal
DISTANCE = 0.25  # from the localised pad's centre, or from the place where the motors stopped [m]
_SLIDE_SPEED = 1.0  # of a vehicle that slides or falls; in its attachment it swings more slowly, and pads move more slowly [m/s]
_IMBALANCE_MIN = 0.8  # least threshold of the imbalance: vibration and attitude errors cause less at rest [m/s^2]
_TILT_MIN = np.radians(8.0)  # least tolerance of the tilt: the grip's play and attitude errors cause less
_UP = np.array([0.0, 0.0, 1.0])


class AdhesionMonitor:
    """Compares the measured specific force with that of a body at rest.

    In flight the only large force is the thrust, along b3: at a perch attitude it cannot carry the weight, so that the
    mean specific force differs from `R_WB^T g e3` by the vehicle's acceleration (at 90 degrees: 9.8 m/s^2 of fall).
    A vehicle that adheres is carried by the surface: the specific force is `R_WB^T g e3`, whatever the motors do.

    At a small tilt the difference is smaller: at theta from the vertical, no thrust comes closer to the weight than g sin(theta)
    (g beyond 90 degrees). So the threshold is half of that, between `_IMBALANCE_MIN` and `IMBALANCE_MAX`, and the tolerance of
    the alignment is at most half of the target's tilt (but `_TILT_MIN` at least), so that a hover is not taken as aligned.
    """

    def __init__(self) -> None:
        self._samples: deque[np.ndarray] = deque(maxlen=_count(NOMINAL_PERIOD))

    def reset(self) -> None:
        """Discard all samples."""
        self._samples.clear()

    def add(self, specific_force_B: np.ndarray, period: float = NOMINAL_PERIOD) -> None:
        """Add IMU samples, shape (n, 3) [m/s^2], that have a period [s]."""
        count = _count(period)
        if count != self._samples.maxlen:
            self._samples = deque(self._samples, count)
        self._samples.extend(np.asarray(specific_force_B, float).reshape(-1, 3))

    @property
    def filled(self) -> bool:
        """Whether the window is full."""
        return len(self._samples) == self._samples.maxlen

    def imbalance(self, q_WB: np.ndarray) -> float:
        """Magnitude of the mean acceleration that the IMU implies at this attitude [m/s^2]."""
        g_B = so3.quat_rotate(so3.quat_conjugate(q_WB), np.array([0.0, 0.0, GRAVITY]))
        return float(np.linalg.norm(np.mean(self._samples, axis=0) - g_B))

    def detached(self, state: State) -> bool:
        """Whether the vehicle has come off, with its motors off: it is fast, or it moves and the specific force is small.

        While the vehicle swings in its attachment, the specific force may also be small for a moment; but the speed stays low.
        """
        if not self.filled:
            return False
        falls = np.linalg.norm(np.mean(self._samples, axis=0)) < 0.4 * GRAVITY
        return bool(np.linalg.norm(state.v_WB) > (SPEED if falls else _SLIDE_SPEED))

    @staticmethod
    def rests(state: State, p_W: np.ndarray) -> bool:
        """Whether the vehicle is slow and still near the place where its motors stopped, `p_W` [m], shape (3,)."""
        return bool(np.linalg.norm(state.v_WB) < SPEED and np.linalg.norm(state.p_WB - p_W) < DISTANCE)

    def attached(self, state: State, target: Target) -> bool:
        """Whether the vehicle rests on the target: in place, aligned, slow, and carried by something other than its rotors."""
        if not self.filled:
            return False
        b3, s3 = so3.quat_rotate(state.q_WB, _UP), so3.quat_rotate(target.q_WS, _UP)
        return bool(
            np.linalg.norm(state.p_WB - target.p_WS) < DISTANCE
            and so3.angle_between(b3, s3) < min(TILT, max(_TILT_MIN, 0.5 * so3.angle_between(s3, _UP)))
            and np.linalg.norm(state.v_WB) < SPEED
            and self.imbalance(state.q_WB) < min(IMBALANCE_MAX, max(_IMBALANCE_MIN, 0.5 * _min_acceleration_in_flight(b3))))

    @staticmethod
    def is_conclusive(state: State) -> bool:
        """Whether rest and flight can be distinguished at this attitude, since no vehicle hovers in it."""
        return _min_acceleration_in_flight(so3.quat_rotate(state.q_WB, _UP)) > 2.0 * _IMBALANCE_MIN


def _count(period: float) -> int:
    """Number of samples in the window."""
    return max(3, round(WINDOW / period))


def _min_acceleration_in_flight(b3: np.ndarray) -> float:
    """Least acceleration of a vehicle in flight with its thrust along b3 (3,): min over T >= 0 of |T b3 - g e3| [m/s^2]."""
    return GRAVITY * (float(np.hypot(b3[0], b3[1])) if b3[2] > 0.0 else 1.0)
