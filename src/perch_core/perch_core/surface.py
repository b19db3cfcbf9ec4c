"""The flat, inclined surface on which the vehicle perches. [M:sec. IV-C]

Frame S: s3 is the *outward* normal, s2 is horizontal and points to the left of the approach heading, s1 = s2 x s3
completes it ("up" on a wall). At contact B and S have the same attitude, as the velcro is under the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core.arrays import Array
from perch_core.errors import ConfigError


@dataclass(frozen=True)
class PerchSurface:
    """A rectangle in space with an outward normal.

    Attributes:
        p_WS: centre in W [m], shape (3,).
        R_WS: columns s1, s2, s3 in W, shape (3, 3).
        size: full extent along s1 and s2 [m].
    """

    p_WS: Array
    R_WS: Array
    size: tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "p_WS", np.array(self.p_WS, dtype=float).reshape(3))
        object.__setattr__(self, "R_WS", np.array(self.R_WS, dtype=float).reshape(3, 3))
        if not np.all(np.isfinite(self.p_WS)):
            raise ConfigError("PerchSurface", "p_WS", f"{self.p_WS.tolist()} is not finite")
        if not np.allclose(self.R_WS @ self.R_WS.T, np.eye(3), atol=1e-6) or np.linalg.det(self.R_WS) < 0:
            raise ConfigError("PerchSurface", "R_WS", f"{self.R_WS.tolist()} is not a rotation")
        if len(self.size) != 2 or not min(self.size) > 0:
            raise ConfigError("PerchSurface", "size", f"{self.size!r} is not two extents > 0 m")

    @classmethod
    def from_inclination(cls, p_WS: Array, inclination: float, heading: float = 0.0,
                         size: tuple[float, float] = (0.6, 0.6)) -> PerchSurface:
        """Return the surface for an approach along `heading`.

        Args:
            p_WS: centre in W [m], shape (3,).
            inclination: angle between the surface and the ground [rad]: 0 a table, pi/2 a wall, pi a ceiling.
            heading: heading of the approach [rad].
            size: full extent along s1 and s2 [m].

        Raises:
            ConfigError: the inclination is outside [0, pi].
        """
        if not 0.0 <= inclination <= np.pi + 1e-12:
            raise ConfigError("PerchSurface", "inclination", f"{inclination!r} is outside [0, pi] rad")
        c, s = np.cos(heading), np.sin(heading)
        s3 = np.array([-np.sin(inclination) * c, -np.sin(inclination) * s, np.cos(inclination)])
        s2 = np.array([-s, c, 0.0])
        return cls(p_WS, np.stack([np.cross(s2, s3), s2, s3], axis=1), size)

    @property
    def normal(self) -> Array:
        """s3, the outward unit normal in W, shape (3,)."""
        return self.R_WS[:, 2]

    @property
    def heading(self) -> float:
        """Heading of the approach [rad], from s2."""
        s2 = self.R_WS[:, 1]
        return float(np.arctan2(-s2[0], s2[1]))

    def to_surface(self, points_W: Array) -> Array:
        """Points of W in S: (..., 3) -> (..., 3) [m]; the third entry is the distance in front of the surface."""
        return (np.asarray(points_W, dtype=float) - self.p_WS) @ self.R_WS

    def distance(self, points_W: Array) -> Array:
        """Signed distance of points (..., 3) from the plane [m], positive on the outer side; shape (...)."""
        return (np.asarray(points_W, dtype=float) - self.p_WS) @ self.normal

    def covers(self, points_W: Array) -> np.ndarray:
        """Whether points (..., 3), projected along s3, fall inside the rectangle; shape (...)."""
        points_S = self.to_surface(points_W)
        inside: np.ndarray = np.all(np.abs(points_S[..., :2]) <= np.array(self.size) / 2, axis=-1)
        return inside
