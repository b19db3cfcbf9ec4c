"""Images of one camera: exposed along the true trajectory, drawn while the flight goes on, delivered at arrival."""

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
    """A frame on its way; `image` is None where the camera takes no images."""

    frame: Frame
    image: ImageToCome | None


class CameraStream:
    """The frames of one camera in order. They are drawn elsewhere while the flight goes on.

    Attributes:
        most_waiting: a frame that begins while so many of this camera are still being drawn goes without its image; None: every
            image is drawn, however long it takes.
        dropped: images that were given up.
        broken: whoever draws the images has ended; the frames come without them.
    """

    def __init__(self, mount: CameraMount, timing: CameraTiming, draw: Callable[..., ImageToCome] | None,
                 noise: np.random.Generator, target_velocity: np.ndarray, start: int) -> None:
        """
        Args:
            mount: the camera as calibrated, for CameraInfo.
            timing: its frames.
            draw: begins an image, `Drawing.draw` of this camera; None: the frames keep their times, but no images are drawn.
            noise: the sensor's own stream; each frame gets a child, so that frames can be drawn in any order.
            target_velocity: of the pad in W [m/s], (3,).
            start: time at which the pad is where the scene has it [ns].
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
        """Start to draw every frame whose exposure has ended by `time` [ns]."""
        while self._next.end <= time:
            frame, self._next = self._next, self._timing.next()
            image = None
            if self._begin is not None and self._overloaded():
                self.dropped += 1
            elif self._begin is not None:
                image = self._begin(self._seen(frame, history))
            self._coming.append(Delivery(frame, image))

    def due(self, time: int) -> Delivery | None:
        """The oldest frame, if it has arrived by `time` [ns]; it stays until `take`."""
        if not self._coming or self._coming[0].frame.arrival > time:
            return None
        frame, image = self._coming[0]
        if image is not None and image.done() and image.result() is None:
            self._coming[0] = Delivery(frame, None)
            self.give_up()
        return self._coming[0]

    def take(self) -> Delivery:
        """Remove the oldest frame."""
        return self._coming.popleft()

    def give_up(self) -> None:
        """An image will never come."""
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
    """The arguments of `Renderer.render`."""
    p_WB, q_WB = between(places)
    return list(zip(p_WB, so3.quat_to_matrix(q_WB))), np.random.default_rng(seed), shift
