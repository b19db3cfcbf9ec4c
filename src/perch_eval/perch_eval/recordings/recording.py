"""Interface of a recording: IMU samples and camera images in the order of their arrival."""

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
from perch_eval.campaign.progress import counted

IMU = "imu"
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")


class RecordingError(PerchError):
    """Raised when a recording, or a file that belongs to it, cannot be read or lacks requested data."""


class Event(NamedTuple):
    """A value of a sensor.

    Attributes:
        source: `imu`, or the name of the camera.
        arrived: time of recording [ns]; the stamp if that is unknown.
        value: sample or image, in the sensor's own axes.
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
        damage: reason why it could not be read completely, valid after reading; empty: it could.
    """
    def __init__(self, path: Path, sensors: Sensors | None) -> None:
        self.path, self.sensors = path, sensors
        self.images: dict[str, int] = {}
        self.samples = 0
        self.damage = ""

    @abstractmethod
    def events(self) -> Iterator[Event]:
        """Yield all events in the order of their arrival; each call starts from the beginning."""

    def read(self) -> Iterator[Event]:
        """Yield the events with a progress display."""
        return counted(self.events(), self.samples + sum(self.images.values()), what="messages")

    @property
    def truth(self) -> Path | None:
        """File of the true motion that belongs to the recording; None if there is none."""
        return None


class _Picture(CameraImage):
    """An image file that is decoded when its pixels are read."""

    __slots__ = ("path", )
    path: Path


def picture(path: Path, stamp: int, name: str, camera: CameraSensor | None) -> CameraImage:
    """Return an image file as a camera's image; in colour unless the camera is grey, 16 bits reduced to the upper 8.

    Args:
        path: of the file; if `camera` is given, the file is decoded only when the pixels are read.
        stamp: [ns].
        name: of the camera.
        camera: the camera; None: the size is that of the file.

    Raises:
        RecordingError: no camera is given and the file cannot be decoded.
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
    image = _Picture(stamp, optical_frame(name), width, height, encoding, lambda region=None: whole())
    image.path = path
    return image


def decoded(path: Path, flag: int) -> np.ndarray | None:
    """The pixels of an image file, uint8; None: it cannot be read. `flag`: OpenCV's IMREAD_GRAYSCALE or IMREAD_COLOR."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        return None
    return cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
