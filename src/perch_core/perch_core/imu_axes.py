"""Rotation of IMU samples into the axes of B, for an IMU mounted in any orientation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from perch_core.sensors import load_sensors
from perch_core.static_transforms import BASE, StaticTransforms
from perch_core.values import ImuSample, Transform

IMU_AXES = "sensor file, config/sensors/<name>.yaml or a path: axes of the IMU; empty: those of its frame by /tf_static"
"""Description of the parameter `sensors` of nodes that use only the IMU's axes from the file."""
_ORIGIN_TOLERANCE = 0.01  # distance of an IMU from the origin of B above which a warning is logged [m]
AXES_OF_B = frozenset(("imu_link", BASE, ""))


class ImuAxes:
    """Rotates samples into the axes of B, by the sensor file if it has an IMU, or else by the sample's frame and `/tf_static`."""

    def __init__(self, warn: Callable[[str, float], None], sensors: str = "") -> None:
        """
        Args:
            warn: called with a warning and the least time between two warnings of its kind [s].
            sensors: sensor file; empty: no file.

        Raises:
            ConfigError: no such file, or a value that is refused.
        """
        imu = load_sensors(sensors).imu if sensors else None
        self._R_BI = None if imu is None else imu.R_BI
        self._warn = warn
        self._transforms = StaticTransforms()
        self._rotations: dict[str, np.ndarray] = {}  # frame -> R_BI

    def add_transform(self, transform: Transform) -> None:
        """Add a transform of `/tf_static`."""
        if problem := self._transforms.add(transform):
            self._warn(f"/tf_static: {problem}", 1.0)
        self._rotations.clear()

    def in_body(self, sample: ImuSample) -> ImuSample | None:
        """Return the sample in the axes of B; None while the axes of its frame are unknown."""
        if self._R_BI is not None:
            return _rotated_sample(sample, self._R_BI)
        if sample.frame in AXES_OF_B:
            return sample
        R_BI = self._axes(sample.frame)
        return None if R_BI is None else _rotated_sample(sample, R_BI)

    def _axes(self, frame: str) -> np.ndarray | None:
        """R_BI of a frame, shape (3, 3); None while it is unknown."""
        if frame not in self._rotations:
            pose = self._transforms.pose(frame)
            if pose is None:
                self._warn(f"imu/data_raw: frame {frame!r} is not imu_link: samples are not used until /tf_static has "
                           f"its transform to {BASE}", 1.0)
                return None
            if (distance := float(np.linalg.norm(pose[0]))) > _ORIGIN_TOLERANCE:
                self._warn(f"imu/data_raw: {frame!r} is {distance:.3f} m from {BASE}, whose origin has to be in the IMU: the distance is not used", 1.0)
            self._rotations[frame] = pose[1]
        return self._rotations[frame]


def _rotated_sample(sample: ImuSample, R_BI: np.ndarray) -> ImuSample:
    return ImuSample(sample.stamp, tuple((R_BI @ np.array(sample.w_B)).tolist()), tuple((R_BI @ np.array(sample.f_B)).tolist()))
