"""Detection of motion in the recent images, independent of the gyro."""

from __future__ import annotations

from collections import deque

import numpy as np
from perch_perception.ukf.stillness import WINDOW
from perch_perception.vio.tracker import Features

STATIC_DURATION = 0.8  # an image without motion for so long shows rest, also under vibration [s]
MIN_TRACKS = 8  # fewer do not show whether there is motion
_MAX_MOTION = 0.7  # largest median motion of tracks at rest [px]
_MIN_SPAN = 0.8  # share of a duration that the frames have to span


class RecentViews:
    """The frames of the last `STATIC_DURATION` seconds."""

    def __init__(self) -> None:
        self._views: deque[tuple[int, Features]] = deque()  # (exposed [ns], features)

    def clear(self) -> None:
        """Discard all frames, e.g. after a change of the camera."""
        self._views.clear()

    def add(self, exposed: int, features: Features) -> None:
        """Add a frame, exposed at a time [ns]."""
        self._views.append((exposed, features))
        while len(self._views) > 2 and self._views[1][0] <= exposed - round(1e9 * STATIC_DURATION):
            self._views.popleft()

    def is_static(self, duration: float = WINDOW) -> bool | None:
        """Whether nothing has moved for a duration [s]; None where the image has too few tracks.

        The default is the duration over which rest is judged. A hover, too, can be still for so long: the image alone does not
        prove rest.
        """
        until, now = self._views[-1]
        since, then = next(((t, f) for t, f in reversed(self._views) if t <= until - round(1e9 * _MIN_SPAN * duration)), self._views[0])
        if len(now.ids) < MIN_TRACKS:
            return None
        _, i, j = np.intersect1d(then.ids, now.ids, assume_unique=True, return_indices=True)
        if len(i) < MIN_TRACKS or until - since < round(1e9 * _MIN_SPAN * duration):
            return False
        return float(np.median(np.linalg.norm(now.pixels[j] - then.pixels[i], axis=1))) < _MAX_MOTION
