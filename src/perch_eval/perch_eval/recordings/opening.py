"""Which kind of recording a path is."""

from __future__ import annotations

from pathlib import Path

from perch_core.sensors import Sensors
from perch_eval.recordings.asl import AslRecording, root_of
from perch_eval.recordings.bag import BagRecording, is_bag
from perch_eval.recordings.pictures import PictureFolder, pictures_in
from perch_eval.recordings.recording import Recording, RecordingError


def open_recording(path: Path, sensors: Sensors | None) -> Recording:
    """The recording at a path.

    Args:
        path: a bag, a folder in the ASL format, a folder of images or an image.
        sensors: its calibration; None: the one that it brings along, or none.

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
    if pictures_in(path):
        return PictureFolder(path, sensors)
    raise RecordingError(f"{path}: is no recording: neither a bag (.bag, .mcap, .db3, a folder with metadata.yaml), nor a folder in the "
                         "format of EuRoC (mav0/cam0/data.csv), nor images")
