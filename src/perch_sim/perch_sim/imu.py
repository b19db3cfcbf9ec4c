"""Model of the IMU: noise, turn-on bias, bias walk, saturation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from perch_core.jit import compiled
from perch_core.vehicle import ImuConfig


class ImuSample(NamedTuple):
    """Sample of the IMU, in the axes of B."""

    accel: np.ndarray  # specific force, (3,) [m/s^2]
    gyro: np.ndarray   # angular velocity, (3,) [rad/s]


class Imu:
    """Turns true specific force and angular velocity into samples.

    The sensor averages over its sample period, so its true input is the mean over the period that ends at the stamp. At
    rest and level it measures +g along z.
    """

    def __init__(self, config: ImuConfig, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        walk = 1.0 / math.sqrt(config.rate)  # standard deviation of a walk over one period, per sqrt(s)
        self._noise = np.repeat([config.accel_noise, config.gyro_noise], 3)
        self._walk = walk * np.repeat([config.accel_bias_walk, config.gyro_bias_walk], 3)
        self._range = np.repeat([config.accel_range, config.gyro_range], 3)
        self.bias = rng.standard_normal(6) * np.repeat([config.accel_bias_init, config.gyro_bias_init], 3)
        _read(np.zeros(6), self.bias.copy(), np.zeros(12), self._walk, self._noise, self._range, np.empty(6))  # loaded now

    def sample(self, inertial: np.ndarray) -> ImuSample:
        """Return one sample.

        Args:
            inertial: mean specific force [m/s^2] and angular velocity [rad/s] at the IMU in B, (6,).
        """
        reading = np.empty(6)
        _read(inertial, self.bias, self._rng.standard_normal(12), self._walk, self._noise, self._range, reading)
        return ImuSample(reading[:3], reading[3:])


@compiled
def _read(inertial, bias, draw, walk, noise, limits, reading):
    """Write a sample to `reading` (6,), and advance the random walk `bias` (6,); `draw` (12,) is white noise of unit variance."""
    for i in range(6):
        bias[i] += walk[i] * draw[i]
        reading[i] = min(max(inertial[i] + bias[i] + noise[i] * draw[6 + i], -limits[i]), limits[i])
