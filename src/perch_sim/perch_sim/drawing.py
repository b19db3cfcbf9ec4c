"""Rendering of the cameras' images: in this process when they are read, or in separate processes in parallel with the flight."""

from __future__ import annotations

import fcntl
import select
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Pipe
from typing import Protocol

import numpy as np

from perch_core.camera import Region
from perch_core.camera_mount import CameraMount
from perch_core.vehicle import load_vehicle
from perch_sim.calibration import true_mounts
from perch_sim.drawing_process import READY_MESSAGE
from perch_sim.rendering import Pose, Renderer, Scene, build_scene
from perch_sim.scenario import Scenario

Exposure = Callable[[], tuple[Sequence[Pose], np.random.Generator, np.ndarray]]  # the arguments of `Renderer.render`, computed on rendering
COMMAND = (sys.executable, "-m", "perch_sim.drawing_process")
PIPE_SIZE = 1 << 20  # holds an image, so that neither end waits for the other [B]


class PendingImage(Protocol):
    """An image that is being rendered.

    Attributes:
        on_demand: whether it is rendered when it is read, so that waiting for it is unnecessary.
    """

    on_demand: bool

    def done(self, timeout: float = 0.0) -> bool:
        """Return whether the image is complete; wait for it up to `timeout` [s]."""

    def result(self, region: Region | None = None) -> np.ndarray | None:
        """Return the image, uint8, as `Renderer.render`; None if the process that renders it has ended.

        Args:
            region: rows and columns that the caller needs; the rest need not be rendered. None: all of it.
        """


class Rendering(Protocol):
    """Renders the images of some cameras."""

    cameras: tuple[str, ...]

    def draw(self, camera: str, exposure: Exposure) -> PendingImage:
        """Begin to render the image of one exposure, by `Renderer.render` of that camera."""

    def ready(self) -> bool:
        """Return whether images can be rendered without a start-up delay."""

    def close(self) -> None:
        """End the rendering processes, if any."""


class OnDemandRendering:
    """Renders images in this process when they are read; images that are not read are never rendered.

    A thread would not be faster where every core runs a flight of its own, and rendering and flight would wait for each
    other's interpreter lock.
    """

    def __init__(self, scenario: Scenario, seed: int, cameras: Collection[str]) -> None:
        """
        Args:
            scenario: provides the scene.
            seed: seed of the flight.
            cameras: names of the cameras that take images; the scene is built when the first image is read.
        """
        self.cameras = tuple(cameras)
        self._scenario, self._seed = scenario, seed
        self._scenes: dict[str, tuple[Scene, CameraMount]] = {}  # they share the scene, and with it its textures
        self._renderers: dict[str, Renderer] = {}

    def draw(self, camera: str, exposure: Exposure) -> PendingImage:
        """As `Rendering.draw`."""
        return _LazyImage(partial(self._render, camera, exposure))

    def _render(self, camera: str, exposure: Exposure, region: Region | None) -> np.ndarray:
        if not self._scenes:
            self._scenes = {name: (scene, mount) for name, scene, mount in _camera_scenes(self._scenario, self._seed, self.cameras)}
        if camera not in self._renderers:
            self._renderers[camera] = Renderer(*self._scenes[camera], self._seed)
        return self._renderers[camera].render(*exposure(), region=region)

    def ready(self) -> bool:
        """Return True: there is no start-up delay to wait for."""
        return True

    def close(self) -> None:
        """Do nothing: there are no processes."""


class _LazyImage:
    on_demand = True

    def __init__(self, render: Callable[..., np.ndarray]) -> None:
        self._render = render
        self._image: np.ndarray | None = None
        self._region: Region | None = None  # that is rendered; None: all of it

    def done(self, timeout: float = 0.0) -> bool:
        return self._image is not None

    def result(self, region: Region | None = None) -> np.ndarray:
        if self._image is None:
            self._image, self._region = self._render(region=region), region
        elif self._region is not None and not _within(region, self._region):
            self._image, self._region = self._render(region=None), None
        return self._image


def _within(part: Region | None, whole: Region) -> bool:
    return part is not None and all(w.start <= p.start and p.stop <= w.stop for p, w in zip(part, whole))


class ProcessRendering:
    """Renders images in one process per camera.

    A thread in the node's process requests the interpreter lock some fifty times per image, and waits each time until the
    node's loop releases it: an image took 30 ms instead of 10, and the loop was delayed as well.
    """

    def __init__(self, scenario: Scenario, seed: int, cameras: Collection[str]) -> None:
        """Start the processes, which draw their textures in the background.

        Args:
            scenario: provides the scene.
            seed: seed of the flight.
            cameras: names of the cameras that take images.

        Raises:
            ConfigError: the scenario's vehicle or board does not exist.
        """
        self.cameras = tuple(cameras)
        self._clients = {name: _RenderClient(scene, mount, seed) for name, scene, mount in _camera_scenes(scenario, seed, cameras)}

    def draw(self, camera: str, exposure: Exposure) -> PendingImage:
        """As `Rendering.draw`."""
        return self._clients[camera].draw(exposure)

    def ready(self) -> bool:
        """Return whether every process has drawn its textures and rendered a first image, or has ended."""
        return all(client.ready() for client in self._clients.values())

    def close(self) -> None:
        """End the processes."""
        for client in self._clients.values():
            client.process.kill()
        for client in self._clients.values():
            client.process.wait()


class _RenderClient:
    """Client of a process that renders the images of one camera, in the order of the requests."""

    def __init__(self, scene: Scene, mount: CameraMount, seed: int) -> None:
        requests, self._requests = Pipe(duplex=False)
        self._images, images = Pipe(duplex=False)
        with suppress(OSError, AttributeError):  # not Linux, or a smaller limit
            fcntl.fcntl(images.fileno(), fcntl.F_SETPIPE_SZ, PIPE_SIZE)
        ends = (requests.fileno(), images.fileno())
        self.process = subprocess.Popen([*COMMAND, *map(str, ends)], pass_fds=ends, process_group=0)  # Ctrl-C is handled by the caller
        for end in (requests, images):
            end.close()  # so that the end of the process is the end of the pipe
        with suppress(OSError):  # it has ended already: detected by the first request
            self._requests.send((scene, mount, seed))
        self._poll = select.poll()  # Connection.poll makes one for every call, which takes 0.1 ms
        self._poll.register(self._images.fileno(), select.POLLIN)
        self._shape = (mount.camera.height, mount.camera.width, 3)[:3 if mount.colour else 2]
        self._pending: deque[_PendingRender] = deque()
        self._ready = self._ended = False

    def ready(self) -> bool:
        """Return whether the process can render without a start-up delay, or has ended."""
        if not self._ready:
            self.receive(0.0)
        return self._ready or self._ended

    def draw(self, exposure: Exposure) -> PendingImage:
        image = _PendingRender(self)
        self._pending.append(image)
        try:
            self._requests.send(exposure())
        except OSError:
            self._end()
        if self._ended:  # an ending process closes its pipes one by one: the request may still have found a reader
            self._end()
        return image

    def receive(self, timeout: float) -> bool:
        """Receive an image, or the ready message before the first one, within a time [s]; return whether one was received."""
        try:
            if self._ended or not self._poll.poll(1e3 * timeout):
                return False
            data = self._images.recv_bytes()
        except (EOFError, OSError):
            self._end()
            return False
        self._ready = True
        if data != READY_MESSAGE:
            self._pending.popleft().complete(np.frombuffer(data, np.uint8).reshape(self._shape))
        return True

    def _end(self) -> None:
        self._ended = True
        while self._pending:
            self._pending.popleft().complete(None)


class _PendingRender:
    on_demand = False

    def __init__(self, client: _RenderClient) -> None:
        self._client, self._complete = client, False
        self._image: np.ndarray | None = None

    def complete(self, image: np.ndarray | None) -> None:
        self._complete, self._image = True, image

    def done(self, timeout: float = 0.0) -> bool:
        while not self._complete and self._client.receive(timeout):
            pass
        return self._complete

    def result(self, region: Region | None = None) -> np.ndarray | None:
        while not self._complete:
            self._client.receive(1.0)
        return self._image


def _camera_scenes(scenario: Scenario, seed: int, cameras: Collection[str]) -> list[tuple[str, Scene, CameraMount]]:
    """Return name, scene and true camera of each camera."""
    scene = build_scene(scenario, seed)
    mounts = true_mounts(scenario, load_vehicle(scenario.vehicle).mounts, seed)
    return [(name, scene, mounts[name]) for name in cameras]
