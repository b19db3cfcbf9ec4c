"""Shape of a hanging wire near a point: a straight line with a little sag.

A catenary is, over a few metres, a parabola in the vertical plane: X(s) = p + s d + kappa/2 s^2 u, with u the upward
normal to d. kappa is w/H, weight per length over tension; a taut wire has kappa = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from perch_core import so3

UP = np.array([0.0, 0.0, 1.0])
PARAMETERS = 5  # offset along e1 and e2 [m], tilt towards e1 and e2 [rad], kappa [1/m]


@dataclass(frozen=True)
class WireCurve:
    """A wire in W.

    Attributes:
        point: p, where s = 0 [m], shape (3,).
        direction: d, unit, shape (3,).
        curvature: kappa [1/m].
    """

    point: np.ndarray
    direction: np.ndarray
    curvature: float = 0.0

    @cached_property
    def axes(self) -> np.ndarray:
        """Columns e1 (horizontal), e2 = u (upward normal) and d, right-handed up to sign, shape (3, 3)."""
        side = np.cross(UP, self.direction)
        if np.linalg.norm(side) < 1e-3:  # a vertical wire does not sag; any normals will do
            side = np.array([1.0, 0.0, 0.0]) - self.direction[0] * self.direction
        side = side / np.linalg.norm(side)
        return np.stack([side, np.cross(self.direction, side), self.direction], axis=1)

    def at(self, s: ArrayLike) -> np.ndarray:
        """Points at s [m], shapes (...) -> (..., 3)."""
        along = np.asarray(s, float)[..., None]
        return self.point + along * self.direction + 0.5 * self.curvature * along * along * self.axes[:, 1]

    def tangent(self, s: ArrayLike) -> np.ndarray:
        """Tangents (not normalised) at s, shapes (...) -> (..., 3)."""
        return self.direction + self.curvature * np.asarray(s, float)[..., None] * self.axes[:, 1]

    def moved(self, step: np.ndarray) -> WireCurve:
        """Return the curve after a change of its five parameters."""
        axes = self.axes
        turn = so3.exp(np.cross(self.direction, axes[:, :2] @ step[2:4]))
        direction = turn @ self.direction
        return WireCurve(self.point + axes[:, :2] @ step[:2], direction / np.linalg.norm(direction),
                         self.curvature + float(step[4]))

    def nearest(self, centres: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return s of the wire's points that are nearest to rays, with two Newton-like corrections for the sag.

        Args:
            centres: origins of the rays [m], shape (n, 3).
            rays: unit rays, shape (n, 3).
        """
        s = np.zeros(len(rays))
        for _ in range(3 if self.curvature else 1):
            point, tangent = self.at(s), self.tangent(s)
            w = point - centres
            across = tangent - np.sum(tangent * rays, axis=1, keepdims=True) * rays  # tangent without its part on the ray
            s = s - np.sum(w * across, axis=1) / np.maximum(np.sum(tangent * across, axis=1), 1e-9)
        return s

    def offsets(self, centres: np.ndarray, rays: np.ndarray) -> Offsets:
        """Return the angles by which rays miss the wire, with derivatives.

        The plane through a ray's origin c and the tangent T at the nearest point P has the normal N = (P - c) x T; the offset
        is the ray's angle to it, r . N / |N|, whose derivative is r' . dN / |N| with r' the ray's part in the plane. s has no
        effect to first order.

        Args:
            centres: origins of the rays [m], shape (n, 3).
            rays: unit rays, shape (n, 3).
        """
        s = self.nearest(centres, rays)
        to_point, tangent = self.at(s) - centres, self.tangent(s)
        normals = np.cross(to_point, tangent)
        size = np.maximum(np.linalg.norm(normals, axis=1), 1e-9)
        normals = normals / size[:, None]
        angles = np.sum(normals * rays, axis=1)
        in_plane = rays - angles[:, None] * normals
        by_point = np.cross(tangent, in_plane) / size[:, None]     # r' . (dP x T) = dP . (T x r')
        by_tangent = np.cross(in_plane, to_point) / size[:, None]
        e1, e2, _ = self.axes.T
        jacobian = np.stack([by_point @ e1, by_point @ e2, s * (by_point @ e1) + by_tangent @ e1,
                             s * (by_point @ e2) + by_tangent @ e2,
                             0.5 * s * s * (by_point @ e2) + s * (by_tangent @ e2)], axis=1)
        return Offsets(angles, normals, jacobian, np.sum(to_point * rays, axis=1), s)


@dataclass(frozen=True)
class Offsets:
    """Offsets of rays from a wire.

    Attributes:
        angles: signed angles by which the rays pass the wire [rad], shape (n,).
        normals: unit normals of the planes through the rays' origins and the wire, shape (n, 3).
        jacobian: derivative of the angles by the wire's five parameters, shape (n, 5).
        ahead: distance of the wire along each ray [m], shape (n,); negative: behind the ray's origin.
        s: the nearest points of the wire [m], shape (n,).
    """

    angles: np.ndarray
    normals: np.ndarray
    jacobian: np.ndarray
    ahead: np.ndarray
    s: np.ndarray
