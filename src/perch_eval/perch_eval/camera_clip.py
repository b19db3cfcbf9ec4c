"""Camera images around a perch as a looping animation (WebP) of all cameras side by side."""

from __future__ import annotations

import base64
import io

import cv2
import numpy as np
from PIL import Image

from perch_core.values import CameraImage
from perch_eval.flight import Flight
from perch_eval.metrics import perch_window

CAMERAS = ("front", "down")
HEIGHT = 270  # of the animation [px]
BEFORE, AFTER, MAX_DURATION = 1.0, 1.0, 10.0  # shown around the perch, and at the most where there is none [s]
PAUSE = 1.0   # on the last frame [s]


def clip(flight: Flight, until: float = np.inf) -> str:
    """Return the animation up to a time [s], at the speed of the flight, as HTML; empty if no image was recorded in the time shown."""
    recorded = {name: found for name in CAMERAS if (found := flight.values(f"camera_{name}/image_raw/compressed"))}
    if not recorded:
        return ""
    last = min(until, max(images[-1][0] for images in recorded.values()))
    window = perch_window(flight)
    start, end = (window[0] - BEFORE, min(until, window[1] + AFTER)) if window else (last - MAX_DURATION, last)
    times = [t for t, _ in next(iter(recorded.values())) if start <= t <= end]
    if not times:
        return ""
    frames = [Image.fromarray(_frame({name: _newest(images, t) for name, images in recorded.items()}, t)) for t in times]
    shown = [round(1e3 * dt) for dt in (*np.diff(times), PAUSE)]
    data = io.BytesIO()
    frames[0].save(data, "WEBP", save_all=True, append_images=frames[1:], duration=shown, loop=0, quality=60)
    encoded = base64.b64encode(data.getvalue()).decode()
    names = " and ".join(f"{name} camera" for name in recorded)
    return (f'<figure><img alt="camera images" src="data:image/webp;base64,{encoded}"><figcaption>{names}, '
            f"{times[0]:.2f} to {times[-1]:.2f} s, at the speed of the flight</figcaption></figure>")


def _newest(images: list[tuple[float, CameraImage]], time: float) -> CameraImage:
    """Return the newest image up to a time [s], or else the first one."""
    return next((image for t, image in reversed(images) if t <= time), images[0][1])


def _frame(images: dict[str, CameraImage], time: float) -> np.ndarray:
    """Pictures side by side, with the time and the cameras' names: uint8 (height, width, 3)."""
    panels = []
    for name, image in images.items():
        pixels = image.pixels()
        assert pixels is not None, "recorded images are files, which have pixels"
        panel = cv2.resize(pixels, (round(pixels.shape[1] * HEIGHT / pixels.shape[0]), HEIGHT), interpolation=cv2.INTER_AREA)
        panel = cv2.cvtColor(panel, cv2.COLOR_GRAY2RGB if panel.ndim == 2 else cv2.COLOR_BGR2RGB)
        for shift, colour in ((1, (0, 0, 0)), (0, (255, 255, 255))):  # a shadow: legible on any background
            place = (8 + shift, HEIGHT - 10 + shift)
            cv2.putText(panel, f"{name}  {time:.2f} s", place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
        panels.append(panel)
    return np.hstack(panels)
