"""An animation of a flight, as GIF or as MP4: room, pad, paths, vehicle, camera image, height and tilt at each moment."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from perch_core import so3
from perch_core.errors import PerchError
from perch_eval.camera_clip import CAMERAS
from perch_eval.campaign.progress import with_progress
from perch_eval.flight_view import ESTIMATE, LIMIT, REFERENCE, TRUTH, FlightView
from perch_eval.metrics import tilt_degrees
from perch_eval.replay.stroboscope import Observer, draw_place, draw_vehicle

DPI = 80
CODECS = ("vp09", "mp4v")  # browsers play the first, older players the second
IMAGES = "camera_{}/image_raw/compressed"  # channel of the images of a camera


class Scene:
    """Draws the frames of one animation on one figure."""

    def __init__(self, view: FlightView, start: float, end: float) -> None:
        """
        Args:
            view: what is shown.
            start, end: time span of the animation [s].
        """
        self._view, self._start = view, start
        self._camera = next((name for name in CAMERAS if view.flight.values(IMAGES.format(name))), "")
        self._images = view.flight.values(IMAGES.format(self._camera))
        self._inside = (view.truth.t >= start) & (view.truth.t <= end)
        self.figure = Figure(figsize=(10.0, 5.4), layout="constrained")
        grid = self.figure.add_gridspec(3, 3)
        self._space = self.figure.add_subplot(grid[:, :2])
        self._image = self.figure.add_subplot(grid[0, 2])
        self._height, self._tilt = self.figure.add_subplot(grid[1, 2]), self.figure.add_subplot(grid[2, 2])
        self._draw_space(end)
        self._draw_plots()

    def _draw_space(self, end: float) -> None:
        view, axes, p = self._view, self._space, self._view.truth.p[self._inside]
        self._observer = Observer(p[-1] - p[0])
        self._vehicle: list[Any] = []
        draw_place(axes, view, self._observer)
        axes.plot(*self._observer.project(p).T, color="0.85", lw=1.0)
        if view.reference is not None:
            keep = (view.reference.t >= self._start) & (view.reference.t <= end)
            axes.plot(*self._observer.project(view.reference.p[keep]).T, color=REFERENCE, lw=1.0, label="reference")
        (self._path,) = axes.plot([], [], color=TRUTH, lw=1.6, label="flown")
        (self._estimated,) = axes.plot([], [], color=ESTIMATE, lw=0.9, ls="--", label="estimate")
        axes.set_aspect("equal")
        axes.margins(0.15)
        axes.axis("off")
        axes.legend(fontsize=8, loc="upper left")
        axes.autoscale_view()
        axes.autoscale(False)

    def _draw_plots(self) -> None:
        truth = self._view.truth
        t = truth.t[self._inside]
        self._height.plot(t, truth.p[self._inside, 2], color=TRUTH, lw=1.1)
        self._height.set_ylabel("z [m]", fontsize=8)
        self._tilt.plot(t, tilt_degrees(truth.q[self._inside]), color=TRUTH, lw=1.1)
        self._tilt.set_ylabel("tilt [deg]", fontsize=8)
        self._tilt.set_xlabel("time [s]", fontsize=8)
        self._cursors = [axes.axvline(self._start, color=LIMIT, lw=0.9) for axes in (self._height, self._tilt)]
        for axes in (self._height, self._tilt):
            axes.grid(alpha=0.3)
            axes.tick_params(labelsize=7)
        self._image.set_xticks([])
        self._image.set_yticks([])
        self._shown = self._image.imshow(np.zeros((480, 640), np.uint8), cmap="gray", vmin=0, vmax=255)
        self._image.set_title(f"{self._camera} camera" if self._camera else "no camera images recorded", fontsize=8)

    def draw(self, time: float) -> None:
        """Show the flight at a time [s]."""
        view, project = self._view, self._observer.project
        self._path.set_data(*project(view.truth.p[self._inside & (view.truth.t <= time)]).T)
        if view.estimate is not None:
            self._estimated.set_data(*project(view.estimate.p[(view.estimate.t >= self._start) & (view.estimate.t <= time)]).T)
        now = view.truth.at(np.array([time]))
        for artist in self._vehicle:
            artist.remove()
        self._vehicle = draw_vehicle(self._space, view.vehicle, now.p[0], so3.quat_to_matrix(now.q[0]), self._observer, to_rgba("0.2"), 5)
        for cursor in self._cursors:
            cursor.set_xdata([time, time])
        self._show_image(time)
        speed = float(np.linalg.norm(now.v[0]))
        self._space.set_title(f"t = {time:.2f} s   {speed:.1f} m/s   tilt {tilt_degrees(now.q)[0]:.0f} deg", fontsize=10)

    def _show_image(self, time: float) -> None:
        images = [image for t, image in self._images if t <= time]
        if images:
            pixels = images[-1].pixels()
            if pixels is not None:
                self._shown.set_data(pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))


def write_animation(scene: Scene, times: np.ndarray, fps: float, path: Path) -> None:
    """Draw a scene at each time and write the frames.

    Args:
        scene: what is drawn.
        times: of the frames [s].
        fps: frames per second of the animation.
        path: ends in .gif or .mp4.

    Raises:
        PerchError: OpenCV has no encoder for MP4.
        OSError: the file could not be written to its end.
    """
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    write(path, fps, with_progress(_frames(scene, times), len(times), unit="frames"))


def _frames(scene: Scene, times: np.ndarray) -> Iterator[np.ndarray]:
    """Pictures, (height, width, 3) RGB."""
    scene.figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(scene.figure)
    for time in times:
        scene.draw(float(time))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _write_gif(path: Path, fps: float, frames: Iterator[np.ndarray]) -> None:
    first, *others = (Image.fromarray(frame) for frame in frames)
    ends = np.round(100.0 / fps * np.arange(1, len(others) + 2)).astype(int)  # GIF delays are multiples of 10 ms
    first.save(path, save_all=True, append_images=others, duration=(10 * np.diff(ends, prepend=0)).tolist(), loop=0)


def _write_mp4(path: Path, fps: float, frames: Iterator[np.ndarray]) -> None:
    writer, count = None, 0
    try:
        for frame in frames:
            height, width = (n - n % 2 for n in frame.shape[:2])  # encoders want even sizes
            if writer is None:
                writer = _encoder(path, fps, (width, height))
            count += 1
            writer.write(cv2.cvtColor(frame[:height, :width], cv2.COLOR_RGB2BGR))
    finally:
        if writer is not None:
            writer.release()
    if int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)) != count:  # OpenCV does not report a full disk
        raise OSError(errno.EIO, "the video is not complete; is the disk full?")


def _encoder(path: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    for codec in CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
        if writer.isOpened():
            return writer
    raise PerchError(f"{path}: OpenCV has no encoder for MP4 ({', '.join(CODECS)}) here; choose a .gif")
