"""Conversion of light to grey levels: lens blur, vignetting, exposure control, shot and read noise.

The noise is taken from a bank that is drawn once and shifted at random for every frame: 300,000 Gaussian numbers per
frame would cost more than all other steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perch_core.camera import Camera, Region
from perch_core.camera_mount import CameraMount

BLUR_REACH = 2   # of the filter that stands for it [px]
PSF_SIGMA = 0.6  # blur of lens and pixel together [px]
VIGNETTE = 0.35  # light lost in the corner of the image
READ_NOISE = 1.5  # [grey levels]
SHOT_NOISE = 0.0375  # variance per grey level at gain 1: about 7000 electrons at 255
BASE_GAIN = 4.0  # at the default exposure under light 1: a short exposure for a fast vehicle
GAIN_RANGE = (1.0, 16.0)
BANK_MARGIN = 256  # room for the random shift of the noise [px]


@dataclass(frozen=True)
class Exposure:
    """Steady state of the driver's exposure control.

    Attributes:
        time: exposure time [s].
        gain: analogue gain.
        brightness: grey level relative to that of the textures.
    """

    time: float
    gain: float
    brightness: float


def control_exposure(mount: CameraMount, light: float) -> Exposure:
    """Return the exposure that keeps the image's brightness: in the dark longer, then with more gain; in bright light shorter."""
    time = float(np.clip(mount.exposure / light, 0.05 * mount.exposure, mount.exposure_max))
    wanted = BASE_GAIN * mount.exposure / (light * time)
    gain = float(np.clip(wanted, *GAIN_RANGE))
    return Exposure(time, gain, gain / wanted)


class Sensor:
    """Imperfections of a camera, determined by a seed; has no mutable state."""

    def __init__(self, camera: Camera, exposure: Exposure, channels: int, seed: int) -> None:
        rng = np.random.default_rng([seed, 1])
        u, v = np.meshgrid(np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy)
        radius = np.hypot(u, v)
        vignette = (1.0 - VIGNETTE * (radius / radius.max()) ** 2) * exposure.brightness
        shape = (camera.height + BANK_MARGIN, camera.width + BANK_MARGIN)
        bank = rng.standard_normal((*shape, channels) if channels > 1 else shape, dtype=np.float32)
        self._vignette = _per_channel(vignette.astype(np.float32), channels)
        self._bank = bank
        variance = READ_NOISE**2 + SHOT_NOISE * exposure.gain * np.arange(256)
        self._sigma = np.sqrt(variance).astype(np.float32)
        self._size = (camera.height, camera.width)

    def blur_region(self, region: Region) -> Region:
        """Return a region widened by the reach of the blur."""
        rows, cols = (slice(max(part.start - BLUR_REACH, 0), min(part.stop + BLUR_REACH, size)) for part, size in zip(region, self._size))
        return rows, cols

    def expose(self, light: np.ndarray, rng: np.random.Generator, region: Region | None = None) -> np.ndarray:
        """Return the noisy image of the light on the sensor, uint8, black outside the region.

        Args:
            light: uint8, shape (height, width) or (height, width, 3), before the optics; must be valid within `blur_region(region)`.
            rng: random generator of this frame's noise.
            region: rows and columns that are read out; None: all.
        """
        region = region or (slice(0, self._size[0]), slice(0, self._size[1]))
        around = self.blur_region(region)
        inner = tuple(slice(part.start - wide.start, part.stop - wide.start) for part, wide in zip(region, around))
        image = cv2.GaussianBlur(light[around], (5, 5), PSF_SIGMA, borderType=cv2.BORDER_REPLICATE)[inner]
        image = cv2.multiply(image, self._vignette[region], dtype=cv2.CV_8U)
        y, x = rng.integers(0, BANK_MARGIN, 2)
        noise = self._bank[y: y + self._size[0], x: x + self._size[1]][region]
        out = np.zeros(light.shape, np.uint8)
        cv2.add(image, cv2.multiply(cv2.LUT(image, self._sigma), noise), dst=out[region], dtype=cv2.CV_8U)
        return out


def _per_channel(plane: np.ndarray, channels: int) -> np.ndarray:
    return cv2.merge([plane] * channels) if channels > 1 else plane
