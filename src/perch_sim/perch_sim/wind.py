"""Wind: a steady part and gusts with Dryden's spectra."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import expm, solve_continuous_lyapunov

from perch_sim.scenario import Wind

LENGTH = 5.0          # scale of the turbulence a few metres above ground [m]
MIN_AIRSPEED = 1.0  # speed at which gusts pass when there is no steady wind [m/s]


def dryden(sigma: float, length: float, airspeed: float) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]:
    """Return Dryden's shaping filters as (A, B, C) with white noise of unit density at the input (MIL-F-8785C).

    Along the wind: sigma sqrt(2T) / (1 + T s). Across it: sigma sqrt(T) (1 + sqrt(3) T s) / (1 + T s)^2, T = L / V.

    Args:
        sigma: standard deviation of each component [m/s].
        length: L [m].
        airspeed: V [m/s].
    """
    T = length / airspeed
    along = (np.array([[-1 / T]]), np.array([1.0]), np.array([sigma * math.sqrt(2 / T)]))
    gain = sigma * math.sqrt(T)
    across = (np.array([[0.0, 1.0], [-1 / T**2, -2 / T]]), np.array([0.0, 1.0]),
              np.array([gain / T**2, gain * math.sqrt(3) / T]))
    return along, across, across


class _Filter:
    """A shaping filter sampled exactly: its stationary variance is the continuous one at any step."""

    def __init__(self, A: np.ndarray, B: np.ndarray, C: np.ndarray, step: float, rng: np.random.Generator) -> None:
        self._transition, self._output, self._rng = expm(A * step), C, rng
        stationary = solve_continuous_lyapunov(A, -np.outer(B, B))
        self._drive = self._root(stationary - self._transition @ stationary @ self._transition.T)
        self._state = self._root(stationary) @ rng.standard_normal(len(B))

    @staticmethod
    def _root(covariance: np.ndarray) -> np.ndarray:
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        return vectors * np.sqrt(np.maximum(values, 0.0))

    def next(self) -> float:
        self._state = self._transition @ self._state + self._drive @ self._rng.standard_normal(len(self._state))
        return float(self._output @ self._state)


class WindField:
    """Air velocity at the vehicle over time."""

    def __init__(self, wind: Wind, step: float, rng: np.random.Generator) -> None:
        """
        Args:
            wind: steady wind and strength of the gusts.
            step: time between calls of `next` [s].
            rng: random stream of the wind.
        """
        self._steady = np.array(wind.steady, float)
        speed = float(np.hypot(self._steady[0], self._steady[1]))
        heading = math.atan2(self._steady[1], self._steady[0]) if speed > 0 else 0.0
        c, s = math.cos(heading), math.sin(heading)
        self._axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._filters = ([] if wind.gust_sigma == 0.0 else
                         [_Filter(*part, step, rng)
                          for part in dryden(wind.gust_sigma, LENGTH, max(speed, MIN_AIRSPEED))])

    def next(self) -> np.ndarray:
        """Return the air velocity in W over the next step, (3,) [m/s]."""
        if not self._filters:
            return self._steady
        return self._steady + self._axes @ np.array([f.next() for f in self._filters])
