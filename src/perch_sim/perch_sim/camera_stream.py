"""Images of one camera: exposed along the true trajectory, rendered while the flight continues, delivered at arrival."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import numpy as np

from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_sim.camera_timing import CameraTiming, Frame
from perch_sim.drawing import Exposure, PendingImage
from perch_sim.rendering import Pose
from perch_sim.state_history import Bracket, StateHistory, between

POSES = 5  # of the body, spread over an exposure


class Delivery(NamedTuple):
    """A frame that was exposed and not yet delivered; `image` is None if it has no image."""

    frame: Frame
    image: PendingImage | None


class CameraStream:
    """Frames of one camera in order. Their images are rendered elsewhere while the flight continues.

    Attributes:
        max_pending_images: while so many images of this camera are being rendered, further frames go without image; None: all images
            are rendered, however long it takes.
        dropped: number of images that were not rendered.
        broken: whether the process that renders the images has ended; frames then have no image.
    """

    def __init__(self, mount: CameraMount, timing: CameraTiming, draw: Callable[..., PendingImage] | None,
                 noise: np.random.Generator, target_velocity: np.ndarray, start: int) -> None:
        """
        Args:
            mount: the camera as calibrated, for CameraInfo.
            timing: generates the frame times.
            draw: begins an image, `Rendering.draw` of this camera; None: only the frame times are simulated.
            noise: random stream of the sensor; each frame gets a child, so that frames can be rendered in any order.
            target_velocity: velocity of the pad in W [m/s], (3,).
            start: time at which the pad has its position in the scene [ns].
        """
        self.mount = mount
        self._timing, self._draw = timing, draw
        self._seed, self._image_count = cast(np.random.SeedSequence, noise.bit_generator.seed_seq), 0
        self._velocity, self._start = target_velocity, start
        self.max_pending_images: int | None = None
        self.dropped = 0
        self.broken = False
        self._next = timing.next()
        self._pending: deque[Delivery] = deque()

    def expose(self, time: int, history: StateHistory) -> None:
        """Begin to render every frame whose exposure has ended by `time` [ns]."""
        while self._next.end <= time:
            frame, self._next = self._next, self._timing.next()
            image = None
            if self._draw is not None and self._overloaded():
                self.dropped += 1
            elif self._draw is not None:
                image = self._draw(self._sample_exposure(frame, history))
            self._pending.append(Delivery(frame, image))

    def due(self, time: int) -> Delivery | None:
        """Return the oldest frame if it has arrived by `time` [ns], otherwise None; the frame remains until `take`."""
        if not self._pending or self._pending[0].frame.arrival > time:
            return None
        frame, image = self._pending[0]
        if image is not None and image.done() and image.result() is None:
            self._pending[0] = Delivery(frame, None)
            self.mark_lost()
        return self._pending[0]

    def take(self) -> Delivery:
        """Remove and return the oldest frame."""
        return self._pending.popleft()

    def mark_lost(self) -> None:
        """Record that an image is lost, as the process that renders it has ended."""
        self.dropped += 1
        self.broken = True

    def _overloaded(self) -> bool:
        pending = sum(d.image is not None and not d.image.done() for d in self._pending)
        return self.max_pending_images is not None and pending >= self.max_pending_images

    def _sample_exposure(self, frame: Frame, history: StateHistory) -> Exposure:
        times = np.linspace(frame.start, frame.end, POSES)
        brackets = [history.bracket(int(t)) for t in times]
        seed = np.random.SeedSequence(self._seed.entropy, spawn_key=(*self._seed.spawn_key, self._image_count))
        self._image_count += 1
        return partial(_exposure, brackets, seed, np.outer((times - self._start) * 1e-9, self._velocity))


def _exposure(brackets: list[Bracket], seed: np.random.SeedSequence, shifts: np.ndarray) -> tuple[list[Pose], np.random.Generator, np.ndarray]:
    """Return the arguments of `Renderer.render`."""
    p_WB, q_WB = between(brackets)
    return list(zip(p_WB, so3.quat_to_matrix(q_WB))), np.random.default_rng(seed), shifts
