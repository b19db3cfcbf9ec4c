"""Pixels of an image as perception requires them: grey or in colour, of the camera's size."""

from __future__ import annotations

import cv2
import numpy as np

from perch_core.camera import Camera, Region
from perch_core.errors import PerchError
from perch_core.values import CameraImage


class ImageError(PerchError):
    """Raised when an image cannot be used because of its encoding, size or data."""


def check_image(image: CameraImage, camera: Camera) -> None:
    """Refuse an image whose encoding or size is not the camera's, without reading its pixels.

    Raises:
        ImageError: an encoding that is not 8 bits per channel, or a size other than the camera's.
    """
    if image.encoding not in CameraImage.CHANNELS:
        raise ImageError(f"image: encoding {image.encoding!r} is not one of {', '.join(CameraImage.CHANNELS)}")
    if (image.width, image.height) != (camera.width, camera.height):
        raise ImageError(f"image: {image.width} x {image.height} px is not the camera's {camera.width} x {camera.height}")


def image_array(image: CameraImage, camera: Camera, region: Region | None = None) -> np.ndarray:
    """Return the pixels, uint8 (height, width) or (height, width, 3) by the encoding.

    Args:
        image: it is rendered or decoded by this call, unless it already was.
        camera: the image's camera.
        region: part whose pixels must be valid; None: the whole image.

    Raises:
        ImageError: see `check_image`; also where pixels are missing or do not match width, height and encoding.
    """
    check_image(image, camera)
    pixels = image.pixels(region)
    if pixels is None:
        raise ImageError("image: there are no pixels")
    shape = (image.height, image.width) if CameraImage.CHANNELS[image.encoding] == 1 else (image.height, image.width, 3)
    if pixels.dtype != np.uint8 or pixels.shape != shape:
        raise ImageError(f"image: pixels {pixels.dtype} {pixels.shape} are not {image.encoding} of {image.width} x {image.height} px")
    return pixels


def mono_image(image: CameraImage, camera: Camera, region: Region | None = None) -> np.ndarray:
    """Return the image in grey, uint8 (height, width). See `image_array`."""
    pixels = image_array(image, camera, region)
    if pixels.ndim == 2:
        return pixels
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY if image.encoding == "bgr8" else cv2.COLOR_RGB2GRAY)


def rgb_image(image: CameraImage, camera: Camera) -> np.ndarray:
    """Return the image in colour, RGB, uint8 (height, width, 3). See `image_array`.

    Raises:
        ImageError: also where the image has no colour.
    """
    pixels = image_array(image, camera)
    if pixels.ndim == 2:
        raise ImageError(f"image: encoding {image.encoding!r} has no colour")
    return np.ascontiguousarray(pixels[..., ::-1]) if image.encoding == "bgr8" else pixels
