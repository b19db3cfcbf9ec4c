"""IMU history for replay: samples are checked, converted into integration steps and cut at any stamp."""

from __future__ import annotations

import enum
from bisect import bisect_right
from collections import deque
from math import hypot

import numpy as np

from perch_core.values import ImuSample
from perch_perception.ukf.config import ImuNoise

_GAP = 3.0  # longest interval between samples that counts as complete, in periods
_GAP_ACCEL = 5.0  # 1 sigma of what a missing sample may have been [m/s^2]
_GAP_GYRO = 2.0  # the same [rad/s]
_PERIODS = 9  # last intervals whose median is the period
_MAX_SQUARE = 1e8  # square of what no IMU measures [rad^2/s^2 + m^2/s^4]
_MEAN_TIME = 0.005  # of the samples whose differences measure the noise [s]
_NOISE_WINDOW = 0.25  # time constant of the measured noise [s]
_MIN_NOISE = 0.1  # least measured variance that is believed, as a share of the sensor file's: that of one that is not shaken


class MeasuredNoise:
    """Density of a sensor's noise, from the third differences of its means over `_MEAN_TIME`.

    A smooth motion vanishes in them, while means over T of white noise of density d give 20 d^2 / T (von Neumann et al. 1941, for
    first differences). Means, since the low-pass filter of an IMU correlates samples of a few milliseconds. The airframe's
    vibration counts as noise. The sensor file's noise holds until samples show another.
    """

    def __init__(self, density: float) -> None:
        """`density`: of the sensor's noise, as in the sensor file [unit/sqrt(Hz)]."""
        self._declared = self._measured = density**2
        self._integral, self._time = (0.0, 0.0, 0.0), 0.0  # of the samples since the last mean
        self._last: tuple[tuple[float, ...], ...] = ()  # the last three means
        self._count = 1  # of estimates; the sensor file's is the first

    def add(self, x: tuple[float, ...], dt: float, after_gap: bool) -> tuple[float, float]:
        """Add a sample (3,), `dt` [s] after the last one; return its variance as measured, and that of the sensor file."""
        if after_gap:
            self._integral, self._time, self._last = (0.0, 0.0, 0.0), 0.0, ()
        else:
            p, q, r = self._integral
            self._integral, self._time = (p + dt * x[0], q + dt * x[1], r + dt * x[2]), self._time + dt
        if self._time > 0.99 * _MEAN_TIME:
            self._add_mean(tuple(value / self._time for value in self._integral), self._time)
            self._integral, self._time = (0.0, 0.0, 0.0), 0.0
        return max(self._measured, _MIN_NOISE * self._declared) / dt, self._declared / dt

    def _add_mean(self, x: tuple[float, ...], duration: float) -> None:
        if len(self._last) == 3:
            a, b, c = self._last
            i, j, k = x[0] - a[0] + 3.0 * (b[0] - c[0]), x[1] - a[1] + 3.0 * (b[1] - c[1]), x[2] - a[2] + 3.0 * (b[2] - c[2])
            square = duration * (i * i + j * j + k * k) / 60.0
            self._count += 1
            self._measured += min(max(duration / _NOISE_WINDOW, 1.0 / self._count), 1.0) * (square - self._measured)
        self._last = (*self._last[-2:], x)


def without_gaps(steps: np.ndarray) -> np.ndarray:
    """Return the IMU steps (m, 9) that samples measured: without those over a gap in the samples, or at the range of the gyro."""
    return steps[steps[:, 7] < _GAP_GYRO**2]


def is_sane(sample: ImuSample) -> bool:
    """Whether a sample is finite and within the range of any real IMU."""
    (a, b, c), (x, y, z) = sample.w_B, sample.f_B
    return a * a + b * b + c * c + x * x + y * y + z * z < _MAX_SQUARE


class ImuOutcome(enum.Enum):
    """Outcome of adding an IMU sample."""

    USED = "used"
    GAP = "used after a gap in the IMU data"
    SATURATED = "used with inflated noise: an axis is at its range"
    NOT_FINITE = "refused: not finite, or beyond any sensor's range"
    NOT_NEWER = "refused: stamp is not newer than the sample before"

    @property
    def used(self) -> bool:
        """Whether the sample became the newest of the buffer."""
        return self not in (ImuOutcome.NOT_NEWER, ImuOutcome.NOT_FINITE)


class ImuBuffer:
    """Integration steps between IMU samples over at least the last `history` seconds.

    Step k leads from sample k-1 to sample k and is a row (dt, gyro, accel, gyro variance, accel variance). The variance is the
    measured one. The IMU's period is the median of the last intervals.
    """

    def __init__(self, imu: ImuNoise, history: float) -> None:
        self._imu = imu
        self._instant = imu.integration == "instant"
        self._gyro, self._accel = MeasuredNoise(imu.gyro_noise_density), MeasuredNoise(imu.accel_noise_density)
        self._keep = round(history * 1e9)
        self._intervals: deque[int] = deque(maxlen=_PERIODS)
        self._ends: list[int] = []
        self._rows: list[tuple[float, ...]] = []
        self._sensor_noise: list[tuple[float, float]] = []  # of the rows: gyro variance, accel variance by the sensor file
        self.last: ImuSample | None = None

    @property
    def newest(self) -> ImuSample:
        """The last sample, which must exist."""
        assert self.last is not None
        return self.last

    @property
    def oldest(self) -> int:
        """Earliest stamp from which replay is possible [ns]."""
        if not self._rows:
            return self.last.stamp if self.last else 0
        return self._ends[0] - round(self._rows[0][0] * 1e9)

    def add(self, sample: ImuSample) -> ImuOutcome:
        """Add a sample; `latest` is then the step to it. A refused sample changes nothing: it may be from another publisher."""
        last, imu = self.last, self._imu
        w, f = sample.w_B, sample.f_B
        if not is_sane(sample):
            return ImuOutcome.NOT_FINITE
        if last is not None and sample.stamp <= last.stamp:
            return ImuOutcome.NOT_NEWER
        outcome = ImuOutcome.USED
        self.last = sample
        if last is None:
            return outcome
        interval = sample.stamp - last.stamp
        dt = interval * 1e-9
        if self._instant:
            u, g = last.w_B, last.f_B
            w = (0.5 * (w[0] + u[0]), 0.5 * (w[1] + u[1]), 0.5 * (w[2] + u[2]))
            f = (0.5 * (f[0] + g[0]), 0.5 * (f[1] + g[1]), 0.5 * (f[2] + g[2]))
        is_gap = self._is_gap(interval)
        (gyro, gyro_alone), (accel, accel_alone) = self._gyro.add(sample.w_B, dt, is_gap), self._accel.add(sample.f_B, dt, is_gap)
        more_gyro = more_accel = 0.0
        if is_gap:
            # the error persists over the gap: its variance must not average out over the one long step
            more_gyro, more_accel, outcome = _GAP_GYRO**2, _GAP_ACCEL**2, ImuOutcome.GAP
        ends = (sample, last) if self._instant else (sample,)  # what the step is made of
        if max(hypot(*s.w_B) for s in ends) >= 0.99 * imu.gyro_range:  # B's axes need not be the sensor's
            more_gyro, outcome = more_gyro + imu.gyro_range**2, ImuOutcome.SATURATED  # it may be off by as much again
        if max(hypot(*s.f_B) for s in ends) >= 0.99 * imu.accel_range:
            more_accel, outcome = more_accel + imu.accel_range**2, ImuOutcome.SATURATED
        self._ends.append(sample.stamp)
        self._rows.append((dt, *w, *f, gyro + more_gyro, accel + more_accel))
        self._sensor_noise.append((gyro_alone + more_gyro, accel_alone + more_accel))
        if sample.stamp - self._ends[0] >= 2 * self._keep:
            old = max(bisect_right(self._ends, sample.stamp - self._keep), 1)
            del self._ends[:old], self._rows[:old], self._sensor_noise[:old]
        return outcome

    def _is_gap(self, interval: int) -> bool:
        """Whether samples are missing in an interval [ns]; the interval is included in the period's median."""
        self._intervals.append(interval)
        period = sorted(self._intervals)[len(self._intervals) // 2]
        return interval > _GAP * period

    @property
    def latest(self) -> tuple[float, ...]:
        """The newest step (dt, gyro, accel, gyro variance, accel variance)."""
        return self._rows[-1]

    @property
    def gyro_sigma(self) -> float:
        """1 sigma of the newest gyro sample [rad/s]; 0 before the second."""
        return float(np.sqrt(self._rows[-1][7])) if self._rows else 0.0

    def run(self, start: int, end: int, sensor_noise: bool = False) -> np.ndarray:
        """Return the steps from stamp `start` to stamp `end` [ns], the first and last cut to fit, shape (m, 9).

        With `sensor_noise`, the variances are those of the sensor file.

        The variances of a cut step are multiplied by the ratio of the whole duration to the remaining one. The two parts of a
        step, used in two runs, then add up to the noise of the whole step.
        """
        if end <= start or not self._ends:
            return np.empty((0, 9))
        first = bisect_right(self._ends, start)
        last = min(bisect_right(self._ends, end - 1), len(self._ends) - 1)
        rows = np.array(self._rows[first : last + 1]).reshape(-1, 9)
        if len(rows) == 0:
            return rows
        if sensor_noise:
            rows[:, 7:] = self._sensor_noise[first : last + 1]
        before, after = start - self._ends[first] + round(rows[0, 0] * 1e9), self._ends[last] - end
        if before <= 0 and after <= 0:
            return rows
        whole_first, whole_last = rows[0, 0], rows[-1, 0]
        rows[0, 0] -= max(0, before) * 1e-9
        rows[-1, 0] -= max(0, after) * 1e-9
        rows[0, 7:] *= whole_first / rows[0, 0]
        if len(rows) > 1:
            rows[-1, 7:] *= whole_last / rows[-1, 0]
        return rows
