"""Targets found by perception: the pad and the powerlines. Stamps are whole nanoseconds, quaternions xyzw."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.lines import Segment


class TargetPose(NamedTuple):
    """Pose of the target's frame S in W.

    Attributes:
        stamp: middle of the last image's exposure on the IMU's clock [ns].
        p_WS: position [m], shape (3,).
        q_WS: attitude, shape (4,).
        covariance: of (position, rotation) in the axes of W relative to the vehicle at the stamp [m, rad], shape (6, 6); the
            odometry's error at the stamp displaces vehicle and target equally and is not included.
    """

    stamp: int
    p_WS: np.ndarray
    q_WS: np.ndarray
    covariance: np.ndarray


class TargetSighting(NamedTuple):
    """Detection of the target in one image; fields as in perch_msgs/TargetDetection.

    Attributes:
        stamp: middle of the exposure [ns].
        found: whether there is a usable pose in W.
        pose: pose of S in W; None: no usable pose.
        pose_camera: pose of S in the camera's optical frame; None: no tag was found.
        ids: tags used.
        reprojection_rms: of the corners [px].
        frames_fused: number of images on which `pose` is based.
        method: joint, average or fused.
        message: why nothing was found, for people.
    """

    stamp: int
    found: bool
    pose: TargetPose | None
    pose_camera: TargetPose | None
    ids: tuple[int, ...]
    reprojection_rms: float
    frames_fused: int
    method: str
    message: str


class MappedPowerline(NamedTuple):
    """One straight segment of the map; fields as in perch_msgs/Powerline.

    Attributes:
        id: number of the segment in the map.
        start, end: in W [m], 3 floats each.
        radius: of the wire [m].
        covariance: of the segment's closest point to its mean [m^2], shape (3, 3).
        direction_sigma: 1 sigma of the direction [rad].
        observations: number of images that support the segment.
    """

    id: int
    start: tuple[float, ...]
    end: tuple[float, ...]
    radius: float
    covariance: np.ndarray
    direction_sigma: float
    observations: int

    @property
    def segment(self) -> Segment:
        """Geometry of the segment.

        Raises:
            PerchError: it is not finite, or its length or radius is not positive.
        """
        return Segment.between(np.array(self.start), np.array(self.end), self.radius, self.id)


class PowerlineMap(NamedTuple):
    """Map of all detected powerlines.

    Attributes:
        stamp: middle of the last image's exposure [ns].
        lines: segments.
        degenerate: whether some line is not determined by the motion so far.
        message: missing information, for people.
    """

    stamp: int
    lines: tuple[MappedPowerline, ...]
    degenerate: bool
    message: str
