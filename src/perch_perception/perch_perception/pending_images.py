"""Images wait until the odometry has passed their exposure: then the same states serve them in every run.

Image and odometry come over different topics, and which is received first depends on the machine. An image that is
handled only once the state after its exposure is known gives the same result whatever the order.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, Callable


FUTURE = 0.5      # an image stamped this much ahead of the odometry cannot be right [s]
LOOK = 0.05       # odometry is taken with each image and tick, and this often where neither comes [s], wall clock
QUEUE_LENGTH = 2  # images that wait in real time; older ones give way


class PendingImages:
    """The queue of images that are not yet handled.

    Args:
        stamp_offset: the camera's stamp minus the middle of the exposure on the IMU's clock [s].
        handle: called once for every image, in the order of arrival, with the image, the middle of its exposure [s] and
            the reason why it must not be used (empty when it may).
    """

    def __init__(self, stamp_offset: float, handle: Callable[[Any, float, str], None]) -> None:
        self._offset, self._handle = stamp_offset, handle
        self._waiting: deque[tuple[Any, float]] = deque()
        self._last = -math.inf
        self.dropped = 0

    def add(self, msg: Any, odometry_time: float, keep_all: bool) -> None:
        """Take an image.

        Args:
            msg: the image, with a header.
            odometry_time: stamp of the newest odometry [s]; -inf before the first.
            keep_all: never drop one for being late (lockstep).
        """
        exposed = round(msg.header.stamp.sec + 1e-9 * msg.header.stamp.nanosec - self._offset, 9)
        self._waiting.append((msg, exposed))
        while not keep_all and len(self._waiting) > QUEUE_LENGTH:
            late, late_exposed = self._waiting.popleft()
            self.dropped += 1
            self._handle(late, late_exposed, "dropped: newer images are waiting")
        self.advance(odometry_time)

    def advance(self, odometry_time: float) -> None:
        """Handle what the odometry has caught up with."""
        while self._waiting:
            msg, exposed = self._waiting[0]
            refusal = ""
            if exposed <= self._last:
                refusal = f"image stamp {exposed:.4f} s is not newer than the last, {self._last:.4f} s"
            elif exposed > odometry_time:
                if not math.isfinite(odometry_time) or exposed <= odometry_time + FUTURE:
                    return
                refusal = f"image stamp {exposed:.4f} s is {exposed - odometry_time:.2f} s ahead of the odometry"
            self._waiting.popleft()
            if not refusal:
                self._last = exposed
            self._handle(msg, exposed, refusal)
