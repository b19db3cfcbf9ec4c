"""Tracks slide: what KLT follows is not a fixed point of the scene.

A patch changes as the view of it does, and KLT's fit moves with it. Measured on rendered flights (docs/ablations.md), the error
of a track is hardly white (0.09 px); it walks, and stands still where the view does. Per frame, in each direction of the image,

    q = slide_turn^2 |d beta| + slide_zoom^2 |d ln distance|,

with beta the direction in which the camera sees the point. A point in the state walks over the scene by that. A track's observations
get the covariance sigma^2 I + walk, counted back from the last one, whose point is the one that is solved for.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from perch_perception.vio.config import FilterConfig


class Sliding:
    """The walk of tracked points, for a focal length in pixels."""

    def __init__(self, config: FilterConfig, focal_length: float) -> None:
        self._sigma = config.pixel_noise / focal_length
        self._turn, self._zoom = (config.slide_turn / focal_length) ** 2, (config.slide_zoom / focal_length) ** 2

    def steps(self, b_before: np.ndarray, b_now: np.ndarray, d_before: np.ndarray, d_now: np.ndarray) -> np.ndarray:
        """Variance q of one frame's walk [rad^2].

        Args:
            b_before, b_now: unit bearings in C in both frames, shape (n, 3).
            d_before, d_now: distances from the camera [m], shape (n,).

        Returns:
            Shape (n,).
        """
        turned = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(b_now - b_before, axis=1), 1.0))
        return self._turn * turned + self._zoom * np.abs(np.log(d_now / d_before))

    def of_points(self, b_before: np.ndarray, b_now: np.ndarray, d_before: np.ndarray, d_now: np.ndarray,
                  R_WC: np.ndarray) -> np.ndarray:
        """Covariance that points in W gain by what their views have changed: across the line of sight only [m^2], shape (n, 3, 3).

        Args:
            b_before, b_now, d_before, d_now: as in `steps`.
            R_WC: attitude of the camera now, shape (3, 3).
        """
        u = b_now @ R_WC.T
        q = self.steps(b_before, b_now, d_before, d_now) * d_now**2
        return q[:, None, None] * (np.eye(3) - u[:, :, None] * u[:, None, :])

    def whitened(self, steps: np.ndarray, rows: np.ndarray, noise: np.ndarray | float = 1.0) -> np.ndarray:
        """Rows of one track's observations, transformed so that their noise is white with the variance sigma^2.

        Args:
            steps: variance of the walk between neighbouring observations, see `steps` [rad^2], shape (m - 1,).
            rows: one row for each observation, shape (m, k).
            noise: white noise of each observation, 1 sigma over `pixel_noise`, shape (m,).
        """
        to_end = np.zeros(len(rows))
        to_end[-2::-1] = np.cumsum(steps[::-1] / self._sigma**2)
        covariance = np.minimum(to_end[:, None], to_end)
        covariance.flat[:: len(rows) + 1] += noise**2
        factor, _ = lapack.dpotrf(covariance, lower=1, clean=0)
        return lapack.dtrtrs(factor, rows, lower=1)[0]

    def spread(self, b_C: np.ndarray, noise: np.ndarray) -> float:
        """1 sigma of a track's bearings (m, 3) with a `noise` (m,) about one point [rad], as far as the bearings tell."""
        chords = np.linalg.norm(np.diff(b_C, axis=0), axis=1)
        return float(np.sqrt(self._sigma**2 * np.mean(noise**2) + self._turn * chords.sum()))
