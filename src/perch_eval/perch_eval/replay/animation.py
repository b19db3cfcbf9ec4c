"""An animation of a flight, as GIF or as MP4."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from perch_core.errors import PerchError
from perch_eval.campaign.progress import counted
from perch_eval.replay.scene import Scene

DPI = 80
CODECS = ("vp09", "mp4v")  # browsers play the first, older players the second


def write_animation(scene: Scene, times: np.ndarray, fps: float, path: Path) -> None:
    """Draw a scene at each time and write the frames.

    Args:
        scene: what is drawn.
        times: of the frames [s].
        fps: frames per second of the animation.
        path: ends in .gif or .mp4.

    Raises:
        PerchError: another ending, or OpenCV has no encoder for MP4.
    """
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    if path.suffix not in writers:
        raise PerchError(f"{path}: the ending is neither .gif nor .mp4")
    writers[path.suffix](path, fps, counted(_frames(scene, times), len(times), what="frames"))


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
    first.save(path, save_all=True, append_images=others, duration=round(1000.0 / fps), loop=0)


def _write_mp4(path: Path, fps: float, frames: Iterator[np.ndarray]) -> None:
    writer = None
    try:
        for frame in frames:
            height, width = (n - n % 2 for n in frame.shape[:2])  # encoders want even sizes
            if writer is None:
                writer = _encoder(path, fps, (width, height))
            writer.write(cv2.cvtColor(frame[:height, :width], cv2.COLOR_RGB2BGR))
    finally:
        if writer is not None:
            writer.release()


def _encoder(path: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    for codec in CODECS:
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)
        if writer.isOpened():
            return writer
    raise PerchError(f"{path}: OpenCV has no encoder for MP4 ({', '.join(CODECS)}) here; choose a .gif")
