"""Folders in the format of EuRoC and TUM-VI (ASL): `mav0/cam0/data.csv`, `mav0/imu0/data.csv`, `sensor.yaml` beside each."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge
from itertools import takewhile
from pathlib import Path

import numpy as np

from perch_core.sensors import Sensors
from perch_core.values import ImuSample
from perch_eval.recordings.calibration import from_asl
from perch_eval.recordings.recording import IMU, Event, Recording, RecordingError, picture

AFTER = 1_000_000_000  # what the IMU says later than this after the last image is left out [ns]
TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0", "gt0")


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
        self.samples = int((self._stamps <= self._frames[-1][0] + AFTER).sum())

    @property
    def truth(self) -> Path | None:
        """File of the ground truth; None if there is none."""
        files = (self._root / name / "data.csv" for name in TRUTHS)
        return next((file for file in files if file.is_file() and file.stat().st_size > 1000), None)

    def events(self) -> Iterator[Event]:
        """Yield events in the order of their stamps, to `AFTER` the last image; at equal stamps, IMU samples come first."""
        cameras, last = self.sensors.cameras if self.sensors is not None else {}, self._frames[-1][0] + AFTER
        samples = takewhile(lambda event: event.arrived <= last, map(self._sample, range(len(self._stamps))))
        frames = (Event(name, stamp, picture(path, stamp, name, cameras.get(name))) for stamp, name, path in self._frames)
        yield from merge(samples, frames, key=lambda event: event.arrived)

    def _sample(self, k: int) -> Event:
        stamp, row = int(self._stamps[k]), self._imu[k].tolist()
        return Event(IMU, stamp, ImuSample(stamp, tuple(row[:3]), tuple(row[3:])))


def _frames(path: Path) -> list[tuple[int, str]]:
    """(stamp [ns], file name) of each image."""
    rows = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        stamp, _, name = line.partition(",")
        if not stamp.strip().isdigit():
            raise RecordingError(f"{path}: line {number}: {stamp[:40]!r} is no stamp in nanoseconds")
        rows.append((int(stamp), name.strip() or f"{stamp.strip()}.png"))
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
