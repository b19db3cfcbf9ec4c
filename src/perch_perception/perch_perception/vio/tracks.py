"""Feature tracks for the filter: bearings by frame, for as long as the frame is in the window."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perch_perception.vio.bearing import Bearings


@dataclass
class Track:
    """One feature: frames in which it was seen, and its bearings there."""

    frames: list[int] = field(default_factory=list)
    b_C: list[np.ndarray] = field(default_factory=list)
    shape: list[np.ndarray] = field(default_factory=list)
    noise: list[float] = field(default_factory=list)


@dataclass
class Tracks:
    """Tracks of all features in the newest frame, by feature number."""

    by_id: dict[int, Track] = field(default_factory=dict)

    def observe(self, frame: int, ids: np.ndarray, bearings: Bearings) -> None:
        """Add the bearings of a frame, ids (n,)."""
        noise = np.ones(len(ids)) if bearings.noise is None else bearings.noise
        for i, b, d, sigma in zip(ids.tolist(), bearings.b_C, bearings.shape, noise.tolist()):
            track = self.by_id.setdefault(i, Track())
            track.frames.append(frame)
            track.b_C.append(b)
            track.shape.append(d)
            track.noise.append(sigma)

    def take_ended(self, ids: np.ndarray) -> dict[int, Track]:
        """Remove and return the tracks that are not among the present ids."""
        present = set(ids.tolist())
        ended = {i: t for i, t in self.by_id.items() if i not in present}
        for i in ended:
            del self.by_id[i]
        return ended

    def forget_before(self, frame: int) -> None:
        """Drop observations of frames older than the window."""
        for track in self.by_id.values():
            k = 0
            while k < len(track.frames) and track.frames[k] < frame:
                k += 1
            if k:
                del track.frames[:k], track.b_C[:k], track.shape[:k], track.noise[:k]
