"""Pixels of an image as it comes over a topic, without copying where that can be avoided."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_core.errors import PerchError


class ImageError(PerchError):
    """An image that cannot be used: its encoding, its size, or its data."""


class RawImage(Protocol):
    """What is needed of `sensor_msgs/Image`."""

    height: int
    width: int
    encoding: str
    step: int
    data: object


CHANNELS = {"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3}


def image_array(msg: RawImage, camera: Camera) -> np.ndarray:
    """The pixels, uint8 (height, width) or (height, width, 3), as a view of the message's data.

    Raises:
        ImageError: an encoding that is not 8 bits per channel, a size other than the camera's, or data cut short.
    """
    if msg.encoding not in CHANNELS:
        raise ImageError(f"image: encoding {msg.encoding!r} is not one of {', '.join(CHANNELS)}")
    if (msg.width, msg.height) != (camera.width, camera.height):
        raise ImageError(f"image: {msg.width} x {msg.height} px is not the camera's {camera.width} x {camera.height}")
    channels = CHANNELS[msg.encoding]
    data = np.frombuffer(msg.data, np.uint8)
    if msg.step < msg.width * channels or data.size < msg.step * msg.height:
        raise ImageError(f"image: {data.size} bytes in rows of {msg.step} are too few for its size")
    rows = data[: msg.step * msg.height].reshape(msg.height, msg.step)[:, : msg.width * channels]
    return rows if channels == 1 else rows.reshape(msg.height, msg.width, channels)


def mono_image(msg: RawImage, camera: Camera) -> np.ndarray:
    """The image in grey, uint8 (height, width). See `image_array`."""
    image = image_array(msg, camera)
    if image.ndim == 2:
        return image
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if msg.encoding == "bgr8" else cv2.COLOR_RGB2GRAY)


def rgb_image(msg: RawImage, camera: Camera) -> np.ndarray:
    """The image in colour, uint8 (height, width, 3). See `image_array`.

    Raises:
        ImageError: also where the image has no colour.
    """
    image = image_array(msg, camera)
    if image.ndim == 2:
        raise ImageError(f"image: encoding {msg.encoding!r} has no colour")
    return np.ascontiguousarray(image[..., ::-1]) if msg.encoding == "bgr8" else image
