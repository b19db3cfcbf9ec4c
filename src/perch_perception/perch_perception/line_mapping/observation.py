"""Sighting of a wire, placed in the map by the pose of the camera at the exposure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perch_core.camera_mount import CameraMount
from perch_perception.line_mapping.detection import LineSighting
from perch_perception.pose_buffer import BodyState


@dataclass(frozen=True)
class LineObservation:
    """One arc in W.

    Attributes:
        time: of the exposure [s].
        p_WC: optical centre [m], shape (3,).
        rays_W: unit rays to the wire's axis, in order, shape (7, 3).
        ends_W: rays to the visible ends, shape (2, 3).
        sigma: 1-sigma of a ray across the arc [rad].
        width: angle between the planes through the optical centre that touch the wire [rad]; 0 where it was not measured.
        R_WC: attitude of the camera, shape (3, 3).
    """

    time: float
    p_WC: np.ndarray
    rays_W: np.ndarray
    ends_W: np.ndarray
    sigma: float
    width: float
    R_WC: np.ndarray = field(default_factory=lambda: np.eye(3))

    @property
    def normal(self) -> np.ndarray:
        """Unit normal in W of the plane through the optical centre, shape (3,)."""
        return np.linalg.eigh(self.rays_W.T @ self.rays_W)[1][:, 0]

    @property
    def middle(self) -> np.ndarray:
        """Ray to the middle of the visible part, shape (3,)."""
        return self.rays_W[len(self.rays_W) // 2]


def place(sighting: LineSighting, body: BodyState, mount: CameraMount) -> LineObservation:
    """Place a sighting from a camera on the body in W."""
    p_WC, R_WC = mount.pose(body.p_WB, body.R_WB)
    return LineObservation(body.time, p_WC, sighting.rays_C @ R_WC.T, sighting.ends_C @ R_WC.T, sighting.sigma,
                           sighting.width, R_WC)
