"""Newest outputs of the perception nodes: the pad and the map of powerlines."""

from __future__ import annotations

import numpy as np

from perch_core.covariance import drift, largest_sigma
from perch_core.errors import PerchError
from perch_core.values import NANOSECONDS, OdometryState, PowerlineMap, TargetPose, seconds
from perch_control.mission.values import Target

FUTURE_TOLERANCE = NANOSECONDS // 10  # a stamp is no more than this ahead of the newest sample [ns]


class Targets:
    """Owns the newest pose of the pad and the newest map.

    Attributes:
        lines: the map of powerlines.
    """

    def __init__(self) -> None:
        self._pad: tuple[TargetPose, np.ndarray] | None = None  # and the covariance of the odometry when it came, shape (6, 6)
        self.lines: PowerlineMap | None = None

    def newest(self, channel: str) -> int | None:
        """Return the stamp of the newest value of `target/pose` or `powerlines` [ns]; None: there was none."""
        value = self.lines if channel == "powerlines" else None if self._pad is None else self._pad[0]
        return None if value is None else value.stamp

    def take_pad(self, pose: TargetPose, x: OdometryState | None, newest: int) -> str:
        """Keep a pose of the pad, or return why it is refused.

        Args:
            pose: of the pad.
            x: the newest odometry.
            newest: the newest stamp of a sensor [ns].
        """
        if x is None:
            return "there is no odometry yet"
        if pose.stamp > newest + FUTURE_TOLERANCE:
            return "its stamp is in the future"
        if self._pad is not None and pose.stamp < self._pad[0].stamp:
            return "it is older than the newest"
        self._pad = pose, x.pose_covariance
        return ""

    def pad(self, x: OdometryState) -> Target | None:
        """Return the pad, with the uncertainty relative to the vehicle: the drift of the odometry since the sighting is added."""
        if self._pad is None:
            return None
        pose, before = self._pad
        covariance = pose.covariance + drift(x.pose_covariance, before, pose.p_WS - x.p_WB)
        return Target(seconds(pose.stamp), pose.p_WS, pose.q_WS / np.linalg.norm(pose.q_WS), largest_sigma(covariance[:3, :3]),
                      largest_sigma(covariance[3:, 3:]))

    def take_lines(self, lines: PowerlineMap, newest: int | None) -> str:
        """Keep a map, or return why it is refused; `newest` as in `take_pad`, None before the first stamp."""
        if newest is None or lines.stamp > newest + FUTURE_TOLERANCE:
            return "its stamp is in the future"
        if self.lines is not None and lines.stamp < self.lines.stamp:
            return "it is older than the newest"
        ids = set[int]()
        try:
            for line in lines.lines:
                _ = line.segment  # raises where it is none
                if line.id in ids:
                    return f"two lines have the id {line.id}"
                ids.add(line.id)
        except PerchError as error:
            return str(error)
        self.lines = lines
        return ""
