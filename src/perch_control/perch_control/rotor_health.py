"""Strength of the rotors: the measured specific force along b3 over the thrust predicted from their commands.

In free flight the accelerometer measures the thrust per mass. Both quantities pass the same low-pass filter, so that a change
of thrust alone leaves their ratio at 1; a deviation means lost thrust, or a mass that differs from the file's. A fast filter
detects rotors that fail in flight; a slow one is accurate enough for planning.
"""

from __future__ import annotations

from math import exp

from perch_control.debounce import Debounce
from perch_core.vehicle import GRAVITY

_STEP = 0.02           # `applied_ratio` follows in steps of this size
_MEAN_TIME = 0.5       # time constant of the mean [s]
_RATIO_MAX = 1.1       # limit of `applied_ratio`
_PLAUSIBLE_MAX = 1.5   # a greater ratio of measured to predicted thrust is a fault of the IMU
_FILTER_TIME = 0.05    # time constant of the fast filter; with 0.316 m/s^2 of noise at 500 Hz the ratio is good to 1 % [s]
_WEAK = 0.77           # ratio below which the rotors are weak; +20 % mass reads 0.83, -15 % on one rotor 0.96
_WEAK_TIME = 0.02      # for so long [s]
_THRUST_MIN = 0.5      # predicted thrust / weight below which the ratio is not evaluated: its noise grows
RATE_MAX = 10.0        # body rate above which it is not evaluated: the IMU does not measure the thrust alone [rad/s]
RESERVE = 0.95         # share of the remaining thrust of weak rotors that a trajectory may demand
HOVER_MIN = 1.12       # remaining thrust / weight below which the vehicle lands at once


class RotorHealth:
    """Owns the filters and the verdict on the rotors.

    Attributes:
        ratio: measured / predicted thrust; 1: as in the vehicle file.
        mean: the same over a longer time.
        applied_ratio: the ratio used for control: 1 until the rotors are weak (then `ratio`, in steps) or the mean is adopted.
        weak: whether the rotors have been found weak since they were started.
    """

    def __init__(self, thrust_to_weight: float) -> None:
        """`thrust_to_weight`: of the vehicle file. `applied_ratio` is never less than what just carries the weight."""
        self._ratio_min = 1.001 / thrust_to_weight
        self.reset()

    def reset(self) -> None:
        """Reset to the rotors of the vehicle file."""
        self.ratio = self.mean = self.applied_ratio = 1.0
        self.weak = False
        self._measured = self._predicted = self._mean_measured = self._mean_predicted = GRAVITY
        self._weak_debounce, self._last = Debounce(_WEAK_TIME), 0.0

    def pause(self, now: float) -> None:
        """Skip a sample that does not show the thrust: the vehicle may be in contact, or it turns too fast."""
        self._weak_debounce.update(False, now)
        self._last = now

    def update(self, measured: float, predicted: float, now: float) -> bool:
        """Take a sample in free air.

        Args:
            measured: specific force along b3 [m/s^2].
            predicted: thrust per mass, from the rotor model with the file's thrust coefficient [m/s^2].
            now: time of the sample [s].

        Returns:
            Whether `applied_ratio` has changed.
        """
        if predicted < _THRUST_MIN * GRAVITY:
            self.pause(now)
            return False
        dt = min(max(now - self._last, 0.0), 0.02)
        k, slow = 1.0 - exp(-dt / _FILTER_TIME), 1.0 - exp(-dt / _MEAN_TIME)
        self._measured += k * (measured - self._measured)
        self._predicted += k * (predicted - self._predicted)
        self._mean_measured += slow * (measured - self._mean_measured)
        self._mean_predicted += slow * (predicted - self._mean_predicted)
        self._last, self.ratio, self.mean = now, self._measured / self._predicted, self._mean_measured / self._mean_predicted
        self.weak = self._weak_debounce.update(self.ratio < _WEAK, now) or self.weak
        return self.weak and self._apply(self.ratio)

    @property
    def plausible_mean(self) -> float:
        """The mean, limited to the plausible range."""
        return min(max(self.mean, self._ratio_min), _PLAUSIBLE_MAX)

    @property
    def adoptable(self) -> float:
        """The ratio that `adopt` would set."""
        return self.applied_ratio if self.weak else self._stepped(self.mean)

    def adopt(self) -> bool:
        """Use the mean as `applied_ratio`; returns whether that changes it. With weak rotors, `applied_ratio` stays."""
        return self._apply(self.adoptable)

    def _apply(self, ratio: float) -> bool:
        before, self.applied_ratio = self.applied_ratio, self._stepped(ratio)
        return self.applied_ratio != before

    def _stepped(self, ratio: float) -> float:
        ratio = min(max(ratio, self._ratio_min), _RATIO_MAX)
        return self.applied_ratio if abs(ratio - self.applied_ratio) < _STEP else ratio
