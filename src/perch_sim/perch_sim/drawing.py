"""Where the cameras' images are drawn while the flight goes on: on threads, or in processes of their own."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Collection, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from multiprocessing.process import BaseProcess
from typing import Protocol

import cv2
import numpy as np

from perch_core.camera import CameraMount
from perch_core.processes import end_with_parent, give_way
from perch_core.scenario import Scenario
from perch_core.vehicle import load_vehicle
from perch_sim.calibration import true_mounts
from perch_sim.rendering import Pose, Renderer, Scene, build_scene


class Drawing(Protocol):
    """Draws images of some cameras."""

    cameras: tuple[str, ...]

    def draw(self, camera: str, poses: Sequence[Pose], rng: np.random.Generator, target_shift: np.ndarray) -> Future:
        """The image to come of one exposure: `Renderer.render` of that camera."""


class DrawnOnThreads:
    """Images drawn by an executor of the caller's, in this process."""

    def __init__(self, scenario: Scenario, seed: int, cameras: Collection[str], executor: Executor) -> None:
        """
        Args:
            scenario: what is seen.
            seed: of the flight.
            cameras: names of those that take images.
            executor: carries the work out.

        Raises:
            ConfigError: the scenario's vehicle or board does not exist.
        """
        self.cameras = tuple(cameras)
        scene, mounts = build_scene(scenario, seed), true_mounts(scenario, load_vehicle(scenario.vehicle).mounts, seed)
        self._renderers = {name: Renderer(scene, mounts[name], seed) for name in cameras}
        self._executor = executor

    def draw(self, camera: str, poses: Sequence[Pose], rng: np.random.Generator, target_shift: np.ndarray) -> Future:
        """As `Drawing.draw`."""
        return self._executor.submit(self._renderers[camera].render, poses, rng, target_shift)


class DrawnInProcesses:
    """Images drawn by one process per camera.

    A thread beside the loop of a node asks for the interpreter's lock some fifty times per image, and waits each time until
    the loop lets go of it: an image took 30 ms instead of 10, and the loop lost time as well.
    """

    def __init__(self, scenario: Scenario, seed: int, cameras: Collection[str]) -> None:
        """Start the processes; they build their scenes while the caller goes on.

        Args:
            scenario: what is seen.
            seed: of the flight.
            cameras: names of those that take images.

        Raises:
            ConfigError: the scenario's vehicle or board does not exist.
        """
        self.cameras = tuple(cameras)
        scene, mounts = build_scene(scenario, seed), true_mounts(scenario, load_vehicle(scenario.vehicle).mounts, seed)
        spawn = multiprocessing.get_context("spawn")
        self._executors = {name: ProcessPoolExecutor(1, spawn, _begin, (scene, mounts[name], seed)) for name in cameras}
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited: Ctrl-C is the vehicle's own matter
        for executor in self._executors.values():
            executor.submit(_ready)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def draw(self, camera: str, poses: Sequence[Pose], rng: np.random.Generator, target_shift: np.ndarray) -> Future:
        """As `Drawing.draw`; the future fails with BrokenExecutor when the camera's process has ended."""
        try:
            return self._executors[camera].submit(_draw, poses, rng, target_shift)
        except BrokenExecutor as error:
            failed: Future = Future()
            failed.set_exception(error)
            return failed

    @property
    def processes(self) -> list[BaseProcess]:
        """One per camera, until it has ended."""
        return [process for executor in self._executors.values() for process in (executor._processes or {}).values()]

    def close(self) -> None:
        """End the processes."""
        for process in self.processes:
            process.terminate()
        for executor in self._executors.values():
            executor.shutdown(wait=False, cancel_futures=True)


_renderer: Renderer  # of a drawing process


def _begin(scene: Scene, mount: CameraMount, seed: int) -> None:
    global _renderer
    end_with_parent(signal.SIGTERM)
    give_way()
    cv2.setNumThreads(1)
    _renderer = Renderer(scene, mount, seed)


def _ready() -> None:
    pass


def _draw(poses: Sequence[Pose], rng: np.random.Generator, target_shift: np.ndarray) -> np.ndarray:
    return _renderer.render(poses, rng, target_shift)
