"""An animation of a flight, as GIF with Pillow or as MP4 with ffmpeg."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg

from perch_core.errors import PerchError
from perch_eval.replay.scene import Scene


def write_animation(scene: Scene, times: np.ndarray, fps: float, path: Path,
                    on_frame: Callable[[int, int], None] = lambda done, total: None) -> None:
    """Draw a scene at each time and write the frames.

    Args:
        scene: what is drawn.
        times: of the frames [s].
        fps: frames per second of the animation.
        path: ends in .gif or .mp4.
        on_frame: told (frames done, frames in all).

    Raises:
        PerchError: another ending, or MP4 without ffmpeg.
    """
    if path.suffix == ".gif":
        writer = PillowWriter(fps=fps)
    elif path.suffix == ".mp4":
        if not FFMpegWriter.isAvailable():
            raise PerchError(f"{path}: MP4 needs ffmpeg, which is not installed: sudo apt install ffmpeg; or choose a .gif")
        writer = FFMpegWriter(fps=fps)
    else:
        raise PerchError(f"{path}: the ending is neither .gif nor .mp4")
    FigureCanvasAgg(scene.figure)
    with writer.saving(scene.figure, str(path), dpi=80):
        for k, time in enumerate(times):
            scene.draw(float(time))
            writer.grab_frame()
            on_frame(k + 1, len(times))
