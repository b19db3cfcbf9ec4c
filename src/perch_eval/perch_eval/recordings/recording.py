"""A recording as its readers give it: data of IMU and cameras in the order of arrival."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from perch_core.errors import PerchError
from perch_core.sensors import CameraSensor, Sensors
from perch_core.urdf import optical_frame
from perch_core.values import CameraImage, ImuSample
from perch_eval.campaign.progress import with_progress

IMU = "imu"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")


class RecordingError(PerchError):
    """A recording, or a file that belongs to it, cannot be read, or does not hold the requested data."""


class Event(NamedTuple):
    """One message of a sensor.

    Attributes:
        source: `imu`, or the name of the camera.
        arrived: when it was recorded [ns]; its stamp where that is not known.
        value: its data, in the sensor's own axes.
    """

    source: str
    arrived: int
    value: ImuSample | CameraImage


class Recording(ABC):
    """One recording.

    Attributes:
        path: of the folder or file.
        sensors: its calibration; None: there is none.
        images: number of images by camera.
        samples: number of IMU samples.
        damage: why it could not be read to its end, known once it has been read; empty: it could.
    """
    def __init__(self, path: Path, sensors: Sensors | None) -> None:
        self.path, self.sensors = path, sensors
        self.images: dict[str, int] = {}
        self.samples = 0
        self.damage = ""

    @abstractmethod
    def events(self) -> Iterator[Event]:
        """Everything in the order in which it arrived; each call begins anew."""

    def read(self) -> Iterator[Event]:
        """The events, counted on their way."""
        return with_progress(self.events(), self.samples + sum(self.images.values()), unit="messages")

    @property
    def truth(self) -> Path | None:
        """The file with the true motion that it brings along; None: none."""
        return None


class _FileImage(CameraImage):
    """An image on file, decoded when its pixels are read."""

    __slots__ = ("path", )
    path: Path


def picture(path: Path, stamp: int, name: str, camera: CameraSensor | None) -> CameraImage:
    """An image file as a camera's image; grey unless the camera delivers colour, 16 bits as their upper 8.

    Args:
        path: of the file; one that cannot be decoded is detected when its pixels are read.
        stamp: [ns].
        name: of the camera.
        camera: what it is; None: as the file has it.

    Raises:
        RecordingError: the size is not given and the file cannot be read.
    """
    flag, encoding = (cv2.IMREAD_COLOR, "bgr8") if camera is None or camera.colour else (cv2.IMREAD_GRAYSCALE, "mono8")
    if camera is None:
        pixels = decoded(path, flag)
        if pixels is None:
            raise RecordingError(f"{path}: is no image that can be read")
        width, height = pixels.shape[1], pixels.shape[0]
    else:
        width, height = camera.width, camera.height
    whole = cache(lambda: decoded(path, flag))
    image = _FileImage(stamp, optical_frame(name), width, height, encoding, lambda region=None: whole())
    image.path = path
    return image


def decoded(path: Path, flag: int) -> np.ndarray | None:
    """The pixels of an image file, uint8; None: it cannot be read. `flag`: OpenCV's IMREAD_GRAYSCALE or IMREAD_COLOR."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        return None
    return cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
