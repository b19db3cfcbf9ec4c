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
from perch_sim.drawing import Exposure, ImageToCome
from perch_sim.rendering import Pose
from perch_sim.state_history import Place, StateHistory, between

POSES = 5  # of the body, spread over an exposure


class Delivery(NamedTuple):
    """A frame that was exposed and not yet delivered; `image` is None if it has no image."""

    frame: Frame
    image: ImageToCome | None


class CameraStream:
    """Frames of one camera in order. Their images are rendered elsewhere while the flight continues.

    Attributes:
        most_waiting: while so many images of this camera are being rendered, further frames go without image; None: all images
            are rendered, however long it takes.
        dropped: number of images that were not rendered.
        broken: whether the process that renders the images has ended; frames then have no image.
    """

    def __init__(self, mount: CameraMount, timing: CameraTiming, draw: Callable[..., ImageToCome] | None,
                 noise: np.random.Generator, target_velocity: np.ndarray, start: int) -> None:
        """
        Args:
            mount: the camera as calibrated, for CameraInfo.
            timing: generates the frame times.
            draw: begins an image, `Drawing.draw` of this camera; None: only the frame times are simulated.
            noise: random stream of the sensor; each frame gets a child, so that frames can be rendered in any order.
            target_velocity: velocity of the pad in W [m/s], (3,).
            start: time at which the pad has its position in the scene [ns].
        """
        self.mount = mount
        self._timing, self._begin = timing, draw
        self._seed, self._drawn = cast(np.random.SeedSequence, noise.bit_generator.seed_seq), 0
        self._velocity, self._start = target_velocity, start
        self.most_waiting: int | None = None
        self.dropped = 0
        self.broken = False
        self._next = timing.next()
        self._coming: deque[Delivery] = deque()

    def expose(self, time: int, history: StateHistory) -> None:
        """Begin to render every frame whose exposure has ended by `time` [ns]."""
        while self._next.end <= time:
            frame, self._next = self._next, self._timing.next()
            image = None
            if self._begin is not None and self._overloaded():
                self.dropped += 1
            elif self._begin is not None:
                image = self._begin(self._seen(frame, history))
            self._coming.append(Delivery(frame, image))

    def due(self, time: int) -> Delivery | None:
        """Return the oldest frame if it has arrived by `time` [ns], otherwise None; the frame remains until `take`."""
        if not self._coming or self._coming[0].frame.arrival > time:
            return None
        frame, image = self._coming[0]
        if image is not None and image.done() and image.result() is None:
            self._coming[0] = Delivery(frame, None)
            self.give_up()
        return self._coming[0]

    def take(self) -> Delivery:
        """Remove and return the oldest frame."""
        return self._coming.popleft()

    def give_up(self) -> None:
        """Record that an image is lost, as the process that renders it has ended."""
        self.dropped += 1
        self.broken = True

    def _overloaded(self) -> bool:
        waiting = sum(d.image is not None and not d.image.done() for d in self._coming)
        return self.most_waiting is not None and waiting >= self.most_waiting

    def _seen(self, frame: Frame, history: StateHistory) -> Exposure:
        places = [history.around(int(t)) for t in np.linspace(frame.start, frame.end, POSES)]
        seed = np.random.SeedSequence(self._seed.entropy, spawn_key=(*self._seed.spawn_key, self._drawn))
        self._drawn += 1
        return partial(_exposure, places, seed, self._velocity * (frame.middle - self._start) * 1e-9)


def _exposure(places: list[Place], seed: np.random.SeedSequence, shift: np.ndarray) -> tuple[list[Pose], np.random.Generator, np.ndarray]:
    """Return the arguments of `Renderer.render`."""
    p_WB, q_WB = between(places)
    return list(zip(p_WB, so3.quat_to_matrix(q_WB))), np.random.default_rng(seed), shift
