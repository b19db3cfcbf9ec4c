"""Recordings: IMU samples and camera images in the order of their arrival; of folders in the format of EuRoC and TUM-VI (ASL), and of
single images without stamps.

ASL: `mav0/cam0/data.csv`, `mav0/imu0/data.csv`, `sensor.yaml` beside each.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import cache
from heapq import merge
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from perch_core.errors import ConfigError, PerchError
from perch_core.sensors import CameraSensor, Sensors
from perch_core.urdf import optical_frame
from perch_core.values import CameraImage, ImuSample
from perch_eval.campaign.progress import with_progress
from perch_eval.recordings.calibration import from_asl

IMU = "imu"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")
IMU_TAIL = 1_000_000_000  # IMU samples later than this after the last image are left out [ns]
GROUND_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "gt0")
PERIOD = 1_000_000_000  # between the stamps that the images are given [ns]


class RecordingError(PerchError):
    """Raised when a recording, or a file that belongs to it, cannot be read or lacks requested data."""


class Event(NamedTuple):
    """A value of a sensor.

    Attributes:
        source: `imu`, or the name of the camera.
        value: sample or image, in the sensor's own axes.
        arrived: time of recording [ns]; None: unknown.
    """

    source: str
    value: ImuSample | CameraImage
    arrived: int | None = None


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
        return with_progress(self.events(), self.samples + sum(self.images.values()), unit="messages")

    @property
    def truth(self) -> Path | None:
        """File of the true motion that belongs to the recording; None if there is none."""
        return None


class _FileImage(CameraImage):
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


def image_files(path: Path) -> list[Path]:
    """Return the image files of a folder in the order of their names, or an image file itself."""
    files = [path] if path.is_file() else sorted(path.iterdir()) if path.is_dir() else []
    return [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file()]


class ImageFolder(Recording):
    """Image files without stamps."""

    def __init__(self, path: Path, sensors: Sensors | None, camera: str | None) -> None:
        """
        Raises:
            ConfigError: the sensor file has no such camera.
        """
        super().__init__(path, sensors)
        self.files = image_files(path)
        cameras = [*sensors.cameras] if sensors is not None else ["camera"]
        if camera is not None and camera not in cameras:
            raise ConfigError("--camera, --front", camera, f"is not one of {', '.join(cameras)}")
        self.camera = camera or next(iter(cameras), "camera")
        self.images = {self.camera: len(self.files)}

    def events(self) -> Iterator[Event]:
        """Yield the images in the order of their names, one per second; undecodable files are left out and listed in `damage`."""
        bad = []
        for number, file in enumerate(self.files):
            try:
                image = picture(file, number * PERIOD, self.camera, None)
            except RecordingError:
                bad.append(file.name)
                continue
            yield Event(self.camera, image)
        self.damage = f"cannot be decoded: {', '.join(bad)}" if bad else ""


def root_of(path: Path) -> Path | None:
    """Return the folder that holds `cam*` of a recording in this format; None if the path is not such a recording."""
    for folder in (path / "mav0", path):
        if any(folder.glob("cam*/data.csv")):
            return folder
    return None


class AslRecording(Recording):
    """A folder in the ASL format. Cameras have the names of their folders."""
    def __init__(self, path: Path, sensors: Sensors | None) -> None:
        """
        Raises:
            RecordingError: a file is missing or malformed.
            ConfigError: a `sensor.yaml` cannot be used.
        """
        root = root_of(path)
        if root is None:
            raise RecordingError(f"{path}: no mav0/cam*/data.csv")
        self._root = root
        folders = {file.parent.name: file.parent for file in sorted(root.glob("cam*/data.csv"))}
        if sensors is None and all((folder / "sensor.yaml").is_file() for folder in folders.values()):
            sensors = from_asl(root)
        super().__init__(path, sensors)
        if sensors is not None:
            missing = sorted(set(sensors.cameras) - set(folders))
            if len(missing) == len(sensors.cameras):
                raise RecordingError(f"{root}: of the cameras {', '.join(missing)} of {sensors.name} there is none, only {', '.join(folders)}")
            folders = {name: folder for name, folder in folders.items() if name in sensors.cameras}
        frames = [(stamp, name, folder / "data" / file) for name, folder in folders.items() for stamp, file in _frames(folder / "data.csv")]
        self._frames = sorted(frames, key=lambda row: row[0])
        if not self._frames:
            raise RecordingError(f"{root}: no image is named in cam*/data.csv")
        self.images = {name: sum(row[1] == name for row in self._frames) for name in folders}
        imu = root / "imu0" / "data.csv"
        self._stamps, self._imu = np.empty(0, np.int64), np.empty((0, 6))
        if imu.is_file():
            self._stamps, self._imu = table(imu, 7)
        self.samples = int((self._stamps <= self._frames[-1][0] + IMU_TAIL).sum())

    @property
    def truth(self) -> Path | None:
        """File of the ground truth; None if there is none."""
        files = (self._root / name / "data.csv" for name in GROUND_TRUTH_FOLDERS)
        return next((file for file in files if file.is_file() and file.stat().st_size > 1000), None)

    def events(self) -> Iterator[Event]:
        """Yield events in the order of their stamps, to `IMU_TAIL` after the last image; at equal stamps, IMU samples come first.

        Images are left out and reported in `damage` if their file is missing or, without a calibration, cannot be decoded.
        """
        last, bad = self._frames[-1][0] + IMU_TAIL, list[Path]()
        samples = takewhile(lambda event: event.value.stamp <= last, map(self._sample, range(len(self._stamps))))
        yield from merge(samples, self._pictures(bad), key=lambda event: event.value.stamp)
        self.damage = f"{len(bad)} of {len(self._frames)} image files are missing or cannot be decoded, the first: {bad[0]}" if bad else ""

    def _pictures(self, bad: list[Path]) -> Iterator[Event]:
        """Yield the images in the order of their stamps; add the files that are left out to `bad`."""
        cameras = self.sensors.cameras if self.sensors is not None else {}
        for stamp, name, path in self._frames:
            try:
                if os.path.isfile(path):  # False also for a name that no file can have
                    yield Event(name, picture(path, stamp, name, cameras.get(name)))
                    continue
            except RecordingError:
                pass
            bad.append(path)

    def _sample(self, k: int) -> Event:
        stamp, row = int(self._stamps[k]), self._imu[k].tolist()
        return Event(IMU, ImuSample(stamp, tuple(row[:3]), tuple(row[3:])))


def _frames(path: Path) -> list[tuple[int, str]]:
    """(stamp [ns], file name) of each image."""
    rows = []
    for line in rows_of(path):
        stamp, _, name = line.partition(",")
        digits = stamp.strip()
        if not digits.isdecimal() or len(digits) > 19 or int(digits) > np.iinfo(np.int64).max:  # int() takes up to 4300 digits
            raise RecordingError(f"{path}: {stamp[:40]!r} is no stamp in nanoseconds")
        rows.append((int(digits), name.strip() or f"{digits}.png"))
    return rows


def rows_of(path: Path) -> list[str]:
    """Return the lines of a file, without empty ones and comments (#).

    Raises:
        RecordingError: it cannot be read.
    """
    try:
        return [line for line in path.read_text(errors="replace").splitlines() if line.strip() and not line.lstrip().startswith("#")]
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


def table(path: Path, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Read a comma-separated table of numbers whose first column is a stamp.

    Args:
        path: of the file.
        columns: number of columns to read, with the stamp.

    Returns:
        Stamps [ns], int64, shape (n,), exact; and the other columns, shape (n, columns - 1).

    Raises:
        RecordingError: it cannot be read, or is no such table.
    """
    rows = rows_of(path)
    try:
        stamps = np.array([int(line.split(",", 1)[0]) for line in rows], np.int64)
        values = np.loadtxt(rows, delimiter=",", usecols=range(1, columns), ndmin=2) if rows else np.empty((0, columns - 1))
    except (ValueError, IndexError, OverflowError) as error:
        raise RecordingError(f"{path}: is no table of a stamp [ns] and {columns - 1} numbers: {error}") from None
    return stamps, values
