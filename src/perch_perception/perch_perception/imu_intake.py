"""IMU samples as the filters take them: in the axes of B, with stamps that can be believed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from perch_core.values import ImuSample, Transform
from perch_perception.stamp_guard import StampGuard, StampVerdict
from perch_perception.static_transforms import BASE, StaticTransforms

AXES_OF_B = frozenset(("imu_link", BASE, ""))


class ImuIntake:
    """Turns samples into the axes of B and judges their stamps.

    Args:
        warn: called with a warning and the least time between two of its kind [s].
        R_BI: axes of the IMU in B, shape (3, 3); None: those of the sample's frame.

    Attributes:
        restarted: the sample taken last belongs to a stream that has started anew; what came before it is of another time.
    """

    def __init__(self, warn: Callable[[str, float], None], R_BI: np.ndarray | None = None) -> None:
        self._warn, self._R_BI = warn, R_BI
        self._guard = StampGuard()
        self._transforms = StaticTransforms()
        self._turns: dict[str, np.ndarray] = {}  # frame -> R_BI
        self.restarted = False

    def add_transform(self, transform: Transform) -> None:
        """Take where a frame is in another."""
        problem = self._transforms.add(transform)
        if problem:
            self._warn(f"/tf_static: {problem}", 1.0)
        self._turns.clear()

    def take(self, sample: ImuSample) -> ImuSample | None:
        """The sample in the axes of B; None where it cannot be used."""
        self.restarted = False
        if self._R_BI is not None:
            sample = _turned(sample, self._R_BI)
        elif sample.frame not in AXES_OF_B:
            R_BI = self._axes(sample.frame)
            if R_BI is None:
                return None
            sample = _turned(sample, R_BI)
        verdict = self._guard.judge(sample.stamp)
        if verdict is StampVerdict.GOOD:
            return sample
        if verdict is StampVerdict.REFUSED:
            self._warn(f"imu/data_raw: stamp {sample.stamp} ns does not follow {self._guard.last} ns: not used", 1.0)
            return None
        self._warn(f"imu/data_raw: stamps go on from {sample.stamp} ns: starting anew", 0.0)
        self.restarted = True
        return sample

    def _axes(self, frame: str) -> np.ndarray | None:
        """R_BI of a frame, shape (3, 3); None where it is not known."""
        if frame not in self._turns:
            place = self._transforms.pose(frame)
            if place is None:
                self._warn(f"imu/data_raw: frame {frame!r} is not imu_link: samples are not used until /tf_static says "
                           f"where it is in {BASE}", 1.0)
                return None
            self._turns[frame] = place[1]
        return self._turns[frame]


def _turned(sample: ImuSample, R_BI: np.ndarray) -> ImuSample:
    return ImuSample(sample.stamp, tuple((R_BI @ np.array(sample.w_B)).tolist()), tuple((R_BI @ np.array(sample.f_B)).tolist()))
