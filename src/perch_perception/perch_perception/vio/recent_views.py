"""Whether anything has moved in the image lately, whatever the gyro says."""

from __future__ import annotations

from collections import deque

import numpy as np
from perch_perception.ukf.stillness import WINDOW
from perch_perception.vio.tracker import Features

STANDS = 0.8  # what is seen not to move for so long stands, however it is shaken [s]
LEAST_TRACKS = 8  # below which a frame says nothing
_MOTION = 0.7  # largest median motion of tracks at rest [px]
_MOST = 0.8  # share of a duration that the frames have to span


class RecentViews:
    """The frames of the last `STANDS` seconds."""

    def __init__(self) -> None:
        self._views: deque[tuple[int, Features]] = deque()  # (exposed [ns], features)

    def clear(self) -> None:
        """Forget them: the camera is another one."""
        self._views.clear()

    def add(self, exposed: int, features: Features) -> None:
        """Keep a frame, exposed at a time [ns]."""
        self._views.append((exposed, features))
        while len(self._views) > 2 and self._views[1][0] <= exposed - round(1e9 * STANDS):
            self._views.popleft()

    def still(self, duration: float = WINDOW) -> bool | None:
        """Whether nothing has moved for so long [s]; None where there is nothing in the image.

        A hover, too, stands still for the duration in which rest is judged, which is the default: it is not for the image alone to say.
        """
        until, now = self._views[-1]
        since, then = next(((t, f) for t, f in reversed(self._views) if t <= until - round(1e9 * _MOST * duration)), self._views[0])
        if len(now.ids) < LEAST_TRACKS:
            return None
        _, i, j = np.intersect1d(then.ids, now.ids, assume_unique=True, return_indices=True)
        if len(i) < LEAST_TRACKS or until - since < round(1e9 * _MOST * duration):
            return False
        return float(np.median(np.linalg.norm(now.pixels[j] - then.pixels[i], axis=1))) < _MOTION
