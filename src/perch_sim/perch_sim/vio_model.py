"""A stand-in for visual-inertial odometry: the truth with drift and noise. It is NOT an estimator.

It exists so that the rest of the stack can be tried without images; flights that count use `perch_perception vio`.

Error model, per pose: position and yaw drift as random walks, roll and pitch do not drift (gravity shows them); on top
comes white noise on position, attitude and velocity. A filter's pose is smooth: from frame to frame it jumps by a
millimetre or two, while its drift grows to a centimetre within a flight. The covariance that goes with a pose is the
white part plus what the drift has grown to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perch_core import so3
from perch_core.config import quantity, text


@dataclass(frozen=True, kw_only=True)
class VioModelParameters:
    """Parameters of the node `vio_model`."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml")
    seed: int = quantity(1, low=0, high=2**31 - 1)
    camera: str = text("down", doc="whose frames are answered")
    latency: float = quantity(0.040, unit="s", low=0.0, high=1.0,
                              doc="exposure to output in real time; in lockstep the scenario's latency.vio counts")
    position_drift: float = quantity(0.004, unit="m/sqrt(s)", low=0.0, doc="random walk of each axis")
    yaw_drift: float = quantity(0.001, unit="rad/sqrt(s)", low=0.0, doc="random walk")
    position_noise: float = quantity(0.0015, unit="m", low=0.0, doc="1 sigma of each axis, white")
    attitude_noise: float = quantity(0.0015, unit="rad", low=0.0, doc="1 sigma of each axis, white")
    velocity_noise: float = quantity(0.03, unit="m/s", low=0.0, doc="1 sigma of each axis, white")


class VioEstimate(NamedTuple):
    """A degraded pose; frames as in nav_msgs/Odometry."""

    p_WB: np.ndarray        # (3,) [m]
    q_WB: np.ndarray        # xyzw, (4,)
    v_WB: np.ndarray        # (3,) [m/s]
    pose_variance: np.ndarray   # x, y, z [m^2], about x, y, z of the map [rad^2], (6,)
    velocity_variance: float    # of each axis [m^2/s^2]


class VioModel:
    """Owns the drift; each call makes the next pose of one flight."""

    def __init__(self, params: VioModelParameters, rng: np.random.Generator) -> None:
        self._params, self._rng = params, rng
        self._drift, self._yaw = np.zeros(3), 0.0
        self._first: float | None = None
        self._last: float | None = None

    def degrade(self, time: float, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray) -> VioEstimate:
        """The pose that a VIO might have found.

        Args:
            time: of the pose [s], later than that of the call before.
            p_WB, q_WB, v_WB: the truth [m, xyzw, m/s].
        """
        k, draw = self._params, self._rng.standard_normal(13)
        root = 0.0 if self._last is None else math.sqrt(max(0.0, time - self._last))
        self._first = time if self._first is None else self._first
        self._last = time
        self._drift = self._drift + k.position_drift * root * draw[:3]
        self._yaw += k.yaw_drift * root * draw[3]
        turn = so3.quat_exp(np.array([0.0, 0.0, self._yaw]))
        shake = so3.quat_exp(k.attitude_noise * draw[4:7])
        age = time - self._first
        variance = np.concatenate([
            np.full(3, k.position_noise**2 + k.position_drift**2 * age),
            np.full(3, k.attitude_noise**2) + np.array([0.0, 0.0, k.yaw_drift**2 * age])])
        return VioEstimate(
            so3.quat_rotate(turn, p_WB) + self._drift + k.position_noise * draw[7:10],
            so3.quat_multiply(turn, so3.quat_multiply(shake, q_WB)),
            so3.quat_rotate(turn, v_WB) + k.velocity_noise * draw[10:13], variance, k.velocity_noise**2)
