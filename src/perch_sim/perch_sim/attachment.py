"""Hold of an attached vehicle: velcro or gripper pull it from its pose at the touch to its pose at rest."""

from __future__ import annotations

import math

import numpy as np

from perch_core import so3
from perch_sim.dynamics import Hold

SETTLING = 0.02  # time constant with which felt or claw draw the vehicle home [s]
FREE = Hold(False, -1, np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


class Attachment:
    """Attachment from a touch on; `hold` returns the ends of the springs over time."""

    def __init__(self, time: float, surface: int, grip_W: np.ndarray, home_W: np.ndarray, q_WB: np.ndarray,
                 b3_home_W: np.ndarray, velocity: np.ndarray) -> None:
        """
        Args:
            time: time of the touch [s].
            surface: row of the surface that holds, -1: a cable.
            grip_W: position of the plate or gripper at the touch (3,) [m].
            home_W: its position at rest (3,) [m].
            q_WB: attitude at the touch, xyzw.
            b3_home_W: direction of b3 at rest; the rotation about b3 is kept.
            velocity: velocity of the surface or cable (3,) [m/s].
        """
        self.surface, self._time, self._velocity = surface, time, np.array(velocity, float)
        b3 = so3.quat_to_matrix(q_WB)[:, 2]
        axis = np.cross(b3, b3_home_W)
        sine = float(np.linalg.norm(axis))
        turn = axis / sine * float(so3.angle_between(b3, b3_home_W)) if sine > 1e-9 else np.zeros(3)
        self._home, self._gap = np.array(home_W, float), grip_W - home_W
        self._q_home = so3.quat_multiply(so3.quat_exp(turn), q_WB)
        self._turn = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(self._q_home), q_WB))

    def hold(self, time: float) -> Hold:
        """Return anchor and attitude of the springs at a time [s]."""
        age = time - self._time
        fade = math.exp(-age / SETTLING)
        q_WB = self._q_home if fade < 1e-6 else so3.quat_multiply(self._q_home, so3.quat_exp(fade * self._turn))
        anchor_W = self._home + self._velocity * age + fade * self._gap
        return Hold(True, self.surface, anchor_W, self._velocity, np.ascontiguousarray(q_WB))
