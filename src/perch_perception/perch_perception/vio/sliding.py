"""Random walk of tracks: the point that KLT tracks is not fixed in the scene.

A patch changes with the view of it, and KLT's fit moves with the patch. Measured on rendered flights (docs/ablations.md), little
of a track's error is white (0.09 px); the rest is a random walk, which stops where the view does. Per frame, in each image
direction,

    q = slide_turn^2 |d beta| + slide_zoom^2 |d ln distance|,

with beta the direction in which the camera sees the point. A point performs this walk in the scene: a step at the distance d' is
d'/d times as large an angle from the distance d. A track's observations get the covariance sigma^2 I + walk, accumulated backwards
from the last one, whose point is the one solved for.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from perch_perception.vio.config import VioConfig


class TrackWalk:
    """Random walk of tracked points, for a focal length in pixels."""

    def __init__(self, config: VioConfig, focal_length: float) -> None:
        self._sigma = config.calibration.track / focal_length
        self._turn, self._zoom = (config.filter.slide_turn / focal_length) ** 2, (config.filter.slide_zoom / focal_length) ** 2

    def steps(self, b_before: np.ndarray, b_now: np.ndarray, d_before: np.ndarray, d_now: np.ndarray) -> np.ndarray:
        """Return the variance q of one frame's walk [rad^2].

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
        """Return the covariance added to points in W by the change of their views, across the line of sight [m^2], (n, 3, 3).

        Args:
            b_before, b_now, d_before, d_now: as in `steps`.
            R_WC: attitude of the camera now, shape (3, 3).
        """
        u = b_now @ R_WC.T
        q = self.steps(b_before, b_now, d_before, d_now) * d_now**2
        return q[:, None, None] * (np.eye(3) - u[:, :, None] * u[:, None, :])

    def whitened(self, steps: np.ndarray, distance: np.ndarray, rows: np.ndarray, noise: np.ndarray | float = 1.0) -> np.ndarray:
        """Transform the rows of one track's observations so that their noise is white with the variance sigma^2.

        Args:
            steps: variance of the walk between neighbouring observations, see `steps` [rad^2], shape (m - 1,).
            distance: from the camera to the point at each observation [m], shape (m,).
            rows: one row for each observation, shape (m, k).
            noise: white noise of each observation, ratio of its 1 sigma to the camera's, shape (m,).
        """
        to_end = np.zeros(len(rows))
        to_end[-2::-1] = np.cumsum((steps * distance[1:] ** 2)[::-1])
        covariance = np.minimum(to_end[:, None], to_end) / (self._sigma**2 * distance[:, None] * distance)
        covariance.flat[:: len(rows) + 1] += noise**2
        factor, _ = lapack.dpotrf(covariance, lower=1, clean=0)
        return lapack.dtrtrs(factor, rows, lower=1)[0]

    def spread(self, b_C: np.ndarray, noise: np.ndarray) -> float:
        """Return 1 sigma of a track's bearings (m, 3) with `noise` (m,) about one point [rad], without the walk by distance."""
        chords = np.linalg.norm(np.diff(b_C, axis=0), axis=1)
        return float(np.sqrt(self._sigma**2 * np.mean(noise**2) + self._turn * chords.sum()))
