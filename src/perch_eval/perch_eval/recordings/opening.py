"""Opening of a recording by its kind: a bag, a folder in the ASL format, or single images without stamps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from perch_core.errors import ConfigError
from perch_core.sensors import Sensors
from perch_eval.recordings.asl import AslRecording, root_of
from perch_eval.recordings.bag import BagRecording, is_bag
from perch_eval.recordings.recording import IMAGE_SUFFIXES, Event, Recording, RecordingError, picture

PERIOD = 1_000_000_000  # between the stamps that the images are given [ns]


def image_files(path: Path) -> list[Path]:
    """Return the image files of a folder in the order of their names, or an image file itself."""
    files = [path] if path.is_file() else sorted(path.iterdir()) if path.is_dir() else []
    return [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES and file.is_file()]


class ImageFolder(Recording):
    """Image files without stamps."""

    def __init__(self, path: Path, sensors: Sensors | None, camera: str | None) -> None:
        """
        Raises:
            RecordingError: there is no image.
            ConfigError: the sensor file has no such camera.
        """
        super().__init__(path, sensors)
        self.files = image_files(path)
        if not self.files:
            raise RecordingError(f"{path}: no image in it")
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
            yield Event(self.camera, image.stamp, image)
        self.damage = f"cannot be decoded: {', '.join(bad)}" if bad else ""


def open_recording(path: Path, sensors: Sensors | None, camera: str | None = None) -> Recording:
    """Open the recording at a path.

    Args:
        path: a bag, a folder in the ASL format, a folder of images or an image.
        sensors: its calibration; None: the recording's own, if there is one.
        camera: that of a folder of images or an image; None: the first of `sensors`.

    Raises:
        RecordingError: it is none of these, or cannot be read.
        ConfigError: its calibration cannot be used.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    if is_bag(path):
        return BagRecording(path, sensors)
    if path.is_dir() and root_of(path) is not None:
        return AslRecording(path, sensors)
    if image_files(path):
        return ImageFolder(path, sensors, camera)
    raise RecordingError(f"{path}: is no recording: neither a bag (.bag, .mcap, .db3, a folder with metadata.yaml), nor a folder in the "
                         "format of EuRoC (mav0/cam0/data.csv), nor images")
