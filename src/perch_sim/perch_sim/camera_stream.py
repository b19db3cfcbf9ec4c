"""Images of one camera: exposed along the true trajectory, drawn while the flight goes on, delivered at arrival."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Executor, Future
from typing import NamedTuple

import numpy as np

from perch_core import so3
from perch_core.camera import CameraMount
from perch_sim.camera_timing import CameraTiming, Frame
from perch_sim.rendering import Renderer
from perch_sim.state_history import StateHistory

POSES = 5  # of the body, spread over an exposure


class Delivery(NamedTuple):
    """A frame on its way; `image` is None where the camera takes no images."""

    frame: Frame
    image: Future[np.ndarray] | None


class CameraStream:
    """The frames of one camera in order. Drawing runs on a pool and overlaps with the flight.

    Attributes:
        most_waiting: a frame that begins while so many of this camera are still being drawn goes without its image; None: every
            image is drawn, however long it takes.
        dropped: images that were given up.
    """

    def __init__(self, mount: CameraMount, timing: CameraTiming, renderer: Renderer | None, pool: Executor | None,
                 noise: np.random.Generator, target_velocity: np.ndarray, start: int) -> None:
        """
        Args:
            mount: the camera as calibrated, for CameraInfo.
            timing: its frames.
            renderer: of the true camera; None: the frames keep their times, but no images are drawn.
            pool: where images are drawn.
            noise: the sensor's own stream; each frame gets a child, so that frames can be drawn in any order.
            target_velocity: of the pad in W [m/s], (3,).
            start: time at which the pad is where the scene has it [ns].
        """
        self.mount = mount
        self._timing, self._renderer, self._pool, self._noise = timing, renderer, pool, noise
        self._velocity, self._start = target_velocity, start
        self.most_waiting: int | None = None
        self.dropped = 0
        self._next = timing.next()
        self._coming: deque[Delivery] = deque()

    def expose(self, time: int, history: StateHistory) -> None:
        """Start to draw every frame whose exposure has ended by `time` [ns]."""
        while self._next.end <= time:
            frame, self._next = self._next, self._timing.next()
            image = None
            if self._renderer is not None and self._overloaded():
                self.dropped += 1
            elif self._renderer is not None:
                image = self._draw(frame, history)
            self._coming.append(Delivery(frame, image))

    def due(self, time: int) -> Delivery | None:
        """The oldest frame, if it has arrived by `time` [ns]; it stays until `take`."""
        return self._coming[0] if self._coming and self._coming[0].frame.arrival <= time else None

    def take(self) -> Delivery:
        """Remove the oldest frame."""
        return self._coming.popleft()

    def _overloaded(self) -> bool:
        waiting = sum(d.image is not None and not d.image.done() for d in self._coming)
        return self.most_waiting is not None and waiting >= self.most_waiting

    def _draw(self, frame: Frame, history: StateHistory) -> Future[np.ndarray]:
        instants = np.linspace(frame.start, frame.end, POSES)
        states = [history.at(int(t)) for t in instants]
        poses = [(s.p_WB, so3.quat_to_matrix(s.q_WB)) for s in states]
        shift = self._velocity * (frame.middle - self._start) * 1e-9
        return self._pool.submit(self._renderer.render, poses, self._noise.spawn(1)[0], shift)
