"""IMU samples as the filters require them: in the axes of B, with checked stamps."""

from __future__ import annotations

from collections.abc import Callable

from perch_core.imu_axes import ImuAxes
from perch_core.values import ImuSample
from perch_perception.stamp_guard import StampGuard, StampVerdict

REPETITIONS = 20  # of a sample, after others: the sensor counts as silent; noise repeats single axes a few times at rest


class ImuIntake:
    """Rotates samples into the axes of B, checks their stamps, and drops those of a sensor that has begun to repeat one sample.

    Attributes:
        axes: rotates the samples; holds the transforms of `/tf_static`.
        restarted: whether the latest sample begins a restarted stream, to which no earlier sample belongs.
    """

    def __init__(self, warn: Callable[[str, float], None], sensors: str = "") -> None:
        """Arguments and errors are those of `ImuAxes`."""
        self._warn = warn
        self.axes = ImuAxes(warn, sensors)
        self._guard = StampGuard()
        self.restarted = False
        self._readings: tuple[tuple[float, ...], ...] = ()  # of the last sample
        self._changes = self._repeated = 0

    def take(self, sample: ImuSample) -> ImuSample | None:
        """Return the sample in the axes of B; None where it cannot be used."""
        self.restarted = False
        taken = self.axes.in_body(sample)
        if taken is None:
            return None
        verdict = self._guard.check(sample.stamp)
        if verdict is StampVerdict.GOOD:
            readings = (sample.w_B, sample.f_B)
            if readings == self._readings:
                self._repeated += 1
            else:
                self._readings, self._changes, self._repeated = readings, self._changes + 1, 0
            if self._changes > 1 and self._repeated >= REPETITIONS:  # one that has never changed may be a source without noise
                self._warn(f"imu/data_raw: the same sample {REPETITIONS} times in a row, after others: the sensor has frozen; not used", 1.0)
                return None
            return taken
        if verdict is StampVerdict.REFUSED:
            self._warn(f"imu/data_raw: stamp {sample.stamp} ns does not follow {self._guard.last} ns: not used", 1.0)
            return None
        self._warn(f"imu/data_raw: stamp jump to {sample.stamp} ns: restarting", 0.0)
        self.restarted = True
        return taken
