"""True perch motions without a simulator: rest on the ground, take-off, hover, perch on an inclined surface.

For testing estimators alone: exact poses, rates and forces from a smooth path by
differential flatness, and simulated readings of a vehicle's IMU.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from perch_core import config, so3
from perch_core.flatness import flat_to_state
from perch_core.surface import PerchSurface
from perch_core.vehicle import GRAVITY, ImuConfig
from scipy.interpolate import make_interp_spline


@dataclass(frozen=True)
class PerchMotionConfig:
    """The phases of the motion. The perch ends with acceleration `alpha` s3 - g and speed `speed` into the surface."""

    ground: float = config.quantity(1.0, unit="s", low=0.0, doc="rest on the ground")
    climb: float = config.quantity(2.0, unit="s", above=0.0, doc="take-off to the hover height")
    hover: float = config.quantity(1.5, unit="s", low=0.0)
    perch: float = config.quantity(1.8, unit="s", above=0.3, doc="duration of the perching trajectory")
    ground_height: float = config.quantity(0.04, unit="m", low=0.0, doc="of the body while it stands")
    height: float = config.quantity(1.2, unit="m", above=0.0, doc="of the hover")
    distance: float = config.quantity(1.7, unit="m", above=0.0)
    rise: float = config.quantity(0.3, unit="m", doc="of the pad above the hover")
    inclination_deg: float = config.quantity(90.0, unit="deg", low=0.0, high=180.0)
    alpha: float = config.quantity(3.3, unit="m/s^2", above=0.0)
    speed: float = config.quantity(0.5, unit="m/s", above=0.0)
    tube: float = config.quantity(0.1, unit="s", above=0.0, doc="time before contact with the terminal acceleration")
    sway: float = config.quantity(0.03, unit="m", low=0.0, doc="amplitude of the wandering in the hover")


@dataclass(frozen=True)
class Motion:
    """A true motion at n times: p_WB, v_WB, w_WB_B, f_B (specific force in B) (n, 3); R_WB (n, 3, 3)."""

    times: np.ndarray
    p_WB: np.ndarray
    v_WB: np.ndarray
    R_WB: np.ndarray
    w_WB_B: np.ndarray
    f_B: np.ndarray

    @property
    def q_WB(self) -> np.ndarray:
        """Attitudes xyzw, shape (n, 4)."""
        return so3.quat_from_matrix(self.R_WB)


@dataclass(frozen=True)
class ImuReadings:
    """IMU readings along a motion: gyro, accel (n, 3), and the true biases (n, 3)."""

    gyro: np.ndarray
    accel: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


def _minimum_jerk(start: float, end: tuple[float, float, float], tube_acceleration: float, T: float, tube: float) -> np.ndarray:
    """Ascending coefficients, degree 9, from rest to (p, v, a) at T with the terminal acceleration held over the tube."""
    n = 10

    def row(t: float, order: int) -> np.ndarray:
        return np.array([0.0 if i < order else factorial(i) / factorial(i - order) * t ** (i - order) for i in range(n)])

    A = np.array([row(0, 0), row(0, 1), row(0, 2), row(0, 3), row(T, 0), row(T, 1), row(T, 2), row(T - tube, 2)])
    b = np.array([start, 0, 0, 0, *end, tube_acceleration])
    i = np.arange(3, n)
    c = i * (i - 1) * (i - 2)
    Q = np.zeros((n, n))
    Q[3:, 3:] = np.outer(c, c) * T ** (i[:, None] + i - 5.0) / (i[:, None] + i - 5.0)
    K = np.block([[Q + 1e-9 * np.eye(n), A.T], [A, np.zeros((len(b), len(b)))]])
    return np.linalg.solve(K, np.concatenate([np.zeros(n), b]))[:n]


def _rise(x: np.ndarray) -> np.ndarray:
    """0 to 1 over [0, 1] with four derivatives zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**5 * (126 + x * (-420 + x * (540 + x * (-315 + 70 * x))))


class PerchMotion:
    """A motion whose state is exact at any time in [0, duration]."""

    def __init__(self, settings: PerchMotionConfig = PerchMotionConfig(), seed: int = 0) -> None:
        self.settings, self.seed = settings, seed
        self.duration = settings.ground + settings.climb + settings.hover + settings.perch
        times = np.arange(0.0, self.duration + 0.0201, 0.02)
        # a spline of degree 7 through the path: position and its derivatives, here up to the fourth, then belong together exactly
        path = make_interp_spline(times, self._position(times), k=7)
        self._path = tuple(path.derivative(k) if k else path for k in range(5))

    @property
    def perch_time(self) -> float:
        """When the perching trajectory begins [s]."""
        return self.duration - self.settings.perch

    def _position(self, t: np.ndarray) -> np.ndarray:
        s, rng = self.settings, np.random.default_rng(self.seed)
        begin = s.ground + s.climb + s.hover
        up = _rise((t - s.ground) / s.climb)
        sway = _rise((t - s.ground - 0.3 * s.climb) / s.climb) * _rise((begin - t) / max(0.5 * s.hover, 1e-3))
        phase, rate = rng.uniform(0, 2 * np.pi, 3), rng.uniform(1.5, 4.0, 3)
        p = s.sway * sway[:, None] * np.sin(rate * t[:, None] + phase)
        p[:, 2] += s.ground_height + (s.height - s.ground_height) * up
        goal = np.array([s.distance, 0.0, s.height + s.rise])
        s3 = PerchSurface.from_inclination(goal, np.radians(s.inclination_deg)).normal
        end_a = s.alpha * s3 - np.array([0, 0, GRAVITY])
        flying = t > begin
        u = np.minimum(t[flying] - begin, s.perch + 0.03)
        for axis, start in enumerate((0.0, 0.0, s.height)):
            c = _minimum_jerk(start, (goal[axis], -s.speed * s3[axis], end_a[axis]), end_a[axis], s.perch, s.tube)
            p[flying, axis] = np.polynomial.polynomial.polyval(u, c)
        return p

    def sample(self, times: np.ndarray) -> Motion:
        """Return the states at times [s], shape (n,)."""
        derivatives = [path(times) for path in self._path]
        states = [flat_to_state(p, v, a, j, s, 0.0, 0.0, 0.0, 1.0) for p, v, a, j, s in zip(*derivatives)]
        R = np.array([s.R_WB for s in states])
        f = np.einsum("nji,nj->ni", R, derivatives[2] + np.array([0, 0, GRAVITY]))
        return Motion(np.asarray(times), derivatives[0], derivatives[1], R, np.array([s.w_WB_B for s in states]), f)


def read_imu(motion: Motion, imu: ImuConfig, rng: np.random.Generator) -> ImuReadings:
    """Return readings of an IMU at the body's origin along a motion sampled at its rate: biases, walks, noise, saturation.

    A sample is the mean over the period that ends at its stamp; over 2 ms the mean of both ends approximates it to 1e-4.
    """
    n = len(motion.times)

    def mean(values: np.ndarray) -> np.ndarray:
        return 0.5 * (values + np.concatenate([values[:1], values[:-1]]))

    def bias(init: float, walk: float) -> np.ndarray:
        steps = rng.normal(0.0, walk / np.sqrt(imu.rate), (n, 3))
        steps[0] = rng.normal(0.0, init, 3)
        return np.cumsum(steps, axis=0)

    gyro_bias, accel_bias = bias(imu.gyro_bias_init, imu.gyro_bias_walk), bias(imu.accel_bias_init, imu.accel_bias_walk)
    gyro = mean(motion.w_WB_B) + gyro_bias + rng.normal(0.0, imu.gyro_noise, (n, 3))
    accel = mean(motion.f_B) + accel_bias + rng.normal(0.0, imu.accel_noise, (n, 3))
    return ImuReadings(np.clip(gyro, -imu.gyro_range, imu.gyro_range),
                       np.clip(accel, -imu.accel_range, imu.accel_range), gyro_bias, accel_bias)
