"""Pictures out of a stream whose length is not known: never more than a few, spread evenly."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Shown(NamedTuple):
    """A picture.

    Attributes:
        stamp: of the image [ns].
        caption: what it shows.
        pixels: bgr, uint8 (height, width, 3).
    """

    stamp: int
    caption: str
    pixels: np.ndarray


class Gallery:
    """Takes every n-th picture that is offered; when it is full, every other goes and n is doubled.

    Attributes:
        shown: the pictures, in their order.
    """
    def __init__(self, most: int = 12) -> None:
        self.shown: list[Shown] = []
        self._most, self._step, self._offered = most, 1, 0

    def due(self, within: int = 1) -> bool:
        """Whether the next picture, or one of the next few, will be taken."""
        return -self._offered % self._step < within

    def offer(self, draw: Callable[[], Shown | None]) -> None:
        """Draw and take the next picture, if it is due and there is one."""
        picture = draw() if self.due() else None
        self._offered += 1
        if picture is None:
            return
        self.shown.append(picture)
        if len(self.shown) >= self._most:
            self.shown, self._step = self.shown[::2], 2 * self._step
