"""Rest, told from the IMU alone: the stance hypothesis of Skog et al. (Zero-velocity detection - an algorithm evaluation, 2010).

Rotors that carry a vehicle shake it, and its controller never stops correcting; what rests is as quiet as the sensor. Under the
hypothesis that the vehicle rests, the accelerometer reads gravity in an unknown constant direction, and the gyro its bias:

    T = 1/N sum ( |f_k - g f_mean/|f_mean||^2 / sigma_a^2 + |w_k - b_g|^2 / sigma_w^2 ),    E[T] = 6.

It holds in any attitude, and needs neither an image nor word from the controller. Constant motion it cannot tell from rest: whoever
says "zero velocity" on it asks first whether that can be (`ukf.rest`, `vio.rest`).
"""

from __future__ import annotations

import numpy as np

from perch_core.vehicle import GRAVITY
from perch_perception.ukf.config import ImuNoise, RestConfig
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.ukf.unscented import ACCEL, DT, GYRO

_LEAST = 10  # samples
_ENTIRE = 0.9  # share of the window that must be there


def still(config: RestConfig, noise: ImuNoise, steps: np.ndarray, gyro_bias: np.ndarray | None = None) -> bool:
    """Whether IMU steps are those of a vehicle at rest.

    Args:
        config: the limit.
        noise: 1 sigma of one sample.
        steps: as from `ImuBuffer.run`, shape (m, 9).
        gyro_bias: what the gyro reads at rest [rad/s], shape (3,); None: it is not known, and its mean stands for it.
    """
    if len(steps) < _LEAST or steps[:, DT].sum() < _ENTIRE * config.window:
        return False
    f, w = steps[:, ACCEL], steps[:, GYRO]
    mean = f.mean(axis=0)
    f = f - mean * (GRAVITY / max(float(np.linalg.norm(mean)), 1e-6))
    w = w - (w.mean(axis=0) if gyro_bias is None else gyro_bias)
    energy = ((f**2).sum() / noise.accel_noise**2 + (w**2).sum() / noise.gyro_noise**2) / (6 * len(steps))
    return bool(energy < config.energy)


def window(config: RestConfig, imu: ImuBuffer, end: int) -> np.ndarray:
    """The steps over which rest at a stamp `end` [ns] is judged, shape (m, 9)."""
    return imu.run(max(imu.oldest, end - round(config.window * 1e9)), end)
