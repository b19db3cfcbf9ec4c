"""IMU samples as the filters take them: in the axes of B, with stamps that can be believed."""

from __future__ import annotations

from collections.abc import Callable

from perch_core.imu_axes import ImuAxes
from perch_core.values import ImuSample
from perch_perception.stamp_guard import StampGuard, StampVerdict


class ImuIntake:
    """Turns samples into the axes of B and judges their stamps.

    Attributes:
        axes: turns them; knows `/tf_static`.
        restarted: the sample taken last belongs to a stream that has started anew; what came before it is of another time.
    """

    def __init__(self, warn: Callable[[str, float], None], sensors: str = "") -> None:
        """Arguments and errors as of `ImuAxes`."""
        self._warn = warn
        self.axes = ImuAxes(warn, sensors)
        self._guard = StampGuard()
        self.restarted = False

    def take(self, sample: ImuSample) -> ImuSample | None:
        """The sample in the axes of B; None where it cannot be used."""
        self.restarted = False
        taken = self.axes.in_body(sample)
        if taken is None:
            return None
        verdict = self._guard.judge(sample.stamp)
        if verdict is StampVerdict.GOOD:
            return taken
        if verdict is StampVerdict.REFUSED:
            self._warn(f"imu/data_raw: stamp {sample.stamp} ns does not follow {self._guard.last} ns: not used", 1.0)
            return None
        self._warn(f"imu/data_raw: stamps go on from {sample.stamp} ns: starting anew", 0.0)
        self.restarted = True
        return taken
