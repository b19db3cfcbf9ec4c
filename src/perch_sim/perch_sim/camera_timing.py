"""Times at which a camera exposes, and at which its images arrive.

All times are on the IMU's clock, in whole nanoseconds, as stamps are. An image carries the stamp of the camera board: the
middle of the exposure plus the camera's stamp offset. It arrives after read-out and transport.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.camera_mount import CameraMount
from perch_core.values import NANOSECONDS

TRIGGER_JITTER = 50_000  # of the exposure's start, one sigma [ns]


class Frame(NamedTuple):
    """One exposure; times in nanoseconds."""

    number: int
    start: int     # of the exposure
    end: int       # of the exposure
    stamp: int     # in the image's header
    arrival: int   # when consumers can have it

    @property
    def middle(self) -> int:
        """Middle of the exposure."""
        return (self.start + self.end) // 2


class CameraTiming:
    """Generates the frames of one camera in order."""

    def __init__(self, mount: CameraMount, exposure: float, first: int, rng: np.random.Generator) -> None:
        """
        Args:
            mount: the true camera.
            exposure: exposure time that the exposure control sets for the light [s].
            first: earliest start of an exposure [ns].
            rng: random stream of this camera.
        """
        self._mount, self._exposure, self._rng = mount, round(exposure * NANOSECONDS), rng
        self._first = first + int(rng.uniform(0.0, 1.0 / mount.rate) * NANOSECONDS)
        self._index = 0

    def next(self) -> Frame:
        """Return the next frame."""
        mount, n = self._mount, self._index
        self._index += 1
        jitter = int(np.clip(self._rng.standard_normal(), -3.0, 3.0) * TRIGGER_JITTER)
        start = self._first + round(n * NANOSECONDS / mount.rate) + jitter + 3 * TRIGGER_JITTER
        end = start + self._exposure
        stamp = (start + end) // 2 + round(mount.stamp_offset * NANOSECONDS)
        delay = mount.readout + self._rng.uniform(mount.transport_min, mount.transport_max)
        return Frame(n, start, end, stamp, end + round(delay * NANOSECONDS))
