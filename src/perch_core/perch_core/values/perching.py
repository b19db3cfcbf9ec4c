"""What is found to perch on: the pad, the powerlines. Stamps are whole nanoseconds, quaternions xyzw."""

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
        covariance: of (position, rotation) in the axes of W relative to the vehicle at the stamp [m, rad], shape (6, 6): the odometry's own
            error there moves vehicle and target alike and is not in it.
    """

    stamp: int
    p_WS: np.ndarray
    q_WS: np.ndarray
    covariance: np.ndarray


class TargetSighting(NamedTuple):
    """What one image showed of the target; fields as in perch_msgs/TargetDetection.

    Attributes:
        stamp: middle of the exposure [ns].
        found: a usable pose in W.
        pose: of S in W; None: none.
        pose_camera: of S in the camera's optical frame; None: no tag was found.
        ids: tags used.
        reprojection_rms: of the corners [px].
        frames_fused: images that `pose` rests on.
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
        id: number under which the map knows it.
        start, end: in W [m], 3 floats each.
        radius: of the wire [m].
        covariance: of the segment's closest point to its mean [m^2], shape (3, 3).
        direction_sigma: 1 sigma of the direction [rad].
        observations: images that support it.
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
        """Its geometry.

        Raises:
            PerchError: not finite, without length or radius.
        """
        return Segment.between(np.array(self.start), np.array(self.end), self.radius, self.id)


class PowerlineMap(NamedTuple):
    """All that is known of the powerlines.

    Attributes:
        stamp: middle of the last image's exposure [ns].
        lines: segments.
        degenerate: the motion so far does not determine some line.
        message: what is missing, for people.
    """

    stamp: int
    lines: tuple[MappedPowerline, ...]
    degenerate: bool
    message: str
