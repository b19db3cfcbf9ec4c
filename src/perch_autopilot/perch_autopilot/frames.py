"""Conversion between the axes of ROS and those of aviation.

    world: ENU (x east, y north, z up)       <->  NED (x north, y east, z down)
    body:  FLU (x forward, y left, z up)     <->  FRD (x forward, y right, z down)

Both changes of axes are their own inverse, so one function serves both ways. Vectors have shape (3,), quaternions are xyzw, shape (4,).
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from perch_core.arrays import Numbers

_H = sqrt(0.5)


WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
BODY = np.diag([1.0, -1.0, -1.0])


def world(v: Numbers) -> np.ndarray:
    """Convert a vector of the world, ENU <-> NED; any unit."""
    return WORLD @ v


def body(v: Numbers) -> np.ndarray:
    """Convert a vector of the body, FLU <-> FRD; any unit."""
    return BODY @ v


def covariance(P: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Convert the covariance of two vectors, shape (6, 6), by the change of axes `WORLD` or `BODY`."""
    both = np.kron(np.eye(2), axes)
    return both @ P @ both.T


def attitude(q: np.ndarray) -> np.ndarray:
    """Convert the attitude of the body in the world: of FLU in ENU <-> of FRD in NED.

        q' = q_NE q q_FB,   q_NE = (1, 1, 0, 0) / sqrt 2,  q_FB = (1, 0, 0, 0),   xyzw; the sign is that with w >= 0
    """
    x, y, z, w = q
    turned = _H * np.array([x + y, x - y, w - z, w + z])
    return turned if turned[3] >= 0.0 else -turned
