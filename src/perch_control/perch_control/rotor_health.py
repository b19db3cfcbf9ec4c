"""Strength of the rotors: the measured specific force along b3 over the thrust predicted from their commands.

In free flight the accelerometer measures the thrust per mass. Both quantities pass the same low-pass filter, so that a change
of thrust alone leaves their ratio at 1; a deviation means lost thrust, or a mass that differs from the file's. A fast filter
detects rotors that fail in flight; a slow one is accurate enough for planning.
"""

from __future__ import annotations

from math import exp

from perch_control.debounce import Debounce
from perch_core.vehicle import GRAVITY

_STEP = 0.02           # the believed ratio follows in steps of this size
_MEAN_TIME = 0.5       # time constant of the mean [s]
_GREATEST = 1.1        # a vehicle is believed to be no stronger than this
_SHOWN_MOST = 1.5      # a greater ratio of felt to promised thrust is a fault of the IMU
_FILTER_TIME = 0.05    # time constant of the fast filter; with 0.316 m/s^2 of noise at 500 Hz the ratio is good to 1 % [s]
_WEAK = 0.77           # felt / promised thrust below which the rotors are weak; +20 % mass reads 0.83, -15 % on one rotor 0.96
_WEAK_TIME = 0.02      # for so long [s]
_THRUST_LEAST = 0.5    # promised thrust / weight below which the ratio is not judged: its noise grows
RATE_MOST = 10.0       # body rate above which it is not judged: what is felt is not the thrust alone [rad/s]
RESERVE = 0.95         # a trajectory may ask for this share of what weak rotors have left
HOVER_LEAST = 1.12     # greatest thrust / weight that is left, below which the vehicle lands at once


class RotorHealth:
    """Owns the filters and the verdict on the rotors.

    Attributes:
        ratio: measured / predicted thrust; 1: as in the vehicle file.
        mean: the same over a longer time.
        believed: the ratio used for control: 1 until the rotors are weak (then `ratio`, in steps), or until the mean is adopted.
        weak: whether the rotors have been found weak since they were started.
    """

    def __init__(self, thrust_to_weight: float) -> None:
        """`thrust_to_weight`: of the vehicle file. `believed` is never less than what just carries the weight."""
        self._least = 1.001 / thrust_to_weight
        self.reset()

    def reset(self) -> None:
        """Reset to the rotors of the vehicle file."""
        self.ratio = self.mean = self.believed = 1.0
        self.weak = False
        self._felt = self._promised = self._mean_felt = self._mean_promised = GRAVITY
        self._low, self._last = Debounce(_WEAK_TIME), 0.0

    def pause(self, now: float) -> None:
        """Skip a sample that does not show the thrust: the vehicle may be in contact, or it turns too fast."""
        self._low.update(False, now)
        self._last = now

    def update(self, felt: float, promised: float, now: float) -> bool:
        """Take a sample in free air.

        Args:
            felt: measured specific force along b3 [m/s^2].
            promised: predicted thrust per mass, from the rotor model with the file's thrust coefficient [m/s^2].
            now: time of the sample [s].

        Returns:
            Whether `believed` has changed.
        """
        if promised < _THRUST_LEAST * GRAVITY:
            self.pause(now)
            return False
        dt = min(max(now - self._last, 0.0), 0.02)
        k, slow = 1.0 - exp(-dt / _FILTER_TIME), 1.0 - exp(-dt / _MEAN_TIME)
        self._felt += k * (felt - self._felt)
        self._promised += k * (promised - self._promised)
        self._mean_felt += slow * (felt - self._mean_felt)
        self._mean_promised += slow * (promised - self._mean_promised)
        self._last, self.ratio, self.mean = now, self._felt / self._promised, self._mean_felt / self._mean_promised
        self.weak = self._low.update(self.ratio < _WEAK, now) or self.weak
        return self.weak and self._believe(self.ratio)

    @property
    def shown(self) -> float:
        """The mean, limited to the plausible range."""
        return min(max(self.mean, self._least), _SHOWN_MOST)

    @property
    def adoptable(self) -> float:
        """The ratio that `adopt` would set."""
        return self.believed if self.weak else self._stepped(self.mean)

    def adopt(self) -> bool:
        """Use the mean as `believed`; returns whether that changes it. With weak rotors, `believed` stays."""
        return self._believe(self.adoptable)

    def _believe(self, ratio: float) -> bool:
        before, self.believed = self.believed, self._stepped(ratio)
        return self.believed != before

    def _stepped(self, ratio: float) -> float:
        ratio = min(max(ratio, self._least), _GREATEST)
        return self.believed if abs(ratio - self.believed) < _STEP else ratio
