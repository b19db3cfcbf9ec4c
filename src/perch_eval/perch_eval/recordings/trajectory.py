"""Trajectories over time, their interpolation at other stamps, and their files (TUM, EuRoC's ground truth)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import so3
from perch_eval.recordings.asl import rows_of, table
from perch_eval.recordings.bag import BagRecording
from perch_eval.recordings.calibration import in_body
from perch_eval.recordings.recording import Recording, RecordingError

MAX_GAP = 0.15  # poses further apart than this are not interpolated [s]


@dataclass(frozen=True)
class Trajectory:
    """Poses of B in W.

    Attributes:
        stamps: ascending, int64 [ns], shape (n,).
        p: position [m], shape (n, 3).
        q: attitude xyzw, shape (n, 4).
    """

    stamps: np.ndarray
    p: np.ndarray
    q: np.ndarray

    @classmethod
    def from_poses(cls, poses: Iterable[tuple[int, Any, Any]]) -> Trajectory:
        """Make a trajectory of (stamp [ns], position, attitude) of each pose."""
        rows = list(poses)
        return cls(np.array([row[0] for row in rows], np.int64), np.array([row[1] for row in rows], float).reshape(-1, 3),
                   np.array([row[2] for row in rows], float).reshape(-1, 4))

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return float(np.linalg.norm(np.diff(self.p, axis=0), axis=1).sum())

    def chosen(self, rows: np.ndarray) -> Trajectory:
        """Return the poses selected by indices or a mask."""
        return Trajectory(self.stamps[rows], self.p[rows], self.q[rows])

    def turned(self, q: np.ndarray, p: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> Trajectory:
        """Return the trajectory of another frame on the same body, with attitude q, xyzw, and position p [m] in this one."""
        return Trajectory(self.stamps, self.p + so3.quat_rotate(self.q, np.asarray(p)), so3.quat_multiply(self.q, q))

    def at(self, stamps: np.ndarray) -> tuple[Trajectory, np.ndarray]:
        """Interpolate the poses.

        Args:
            stamps: ascending [ns], shape (m,).

        Returns:
            The poses at the stamps that are within the trajectory and not in a gap, and the mask of these stamps, shape (m,).
        """
        if len(self) < 2:
            return self.chosen(np.zeros(0, int)), np.zeros(len(stamps), bool)
        right = np.clip(np.searchsorted(self.stamps, stamps), 1, len(self) - 1)
        left = right - 1
        span = self.stamps[right] - self.stamps[left]
        known = (stamps == self.stamps[left]) | (stamps == self.stamps[right])
        good = (stamps >= self.stamps[0]) & (stamps <= self.stamps[-1]) & ((span <= MAX_GAP * 1e9) | known)
        left, right, span, stamps = left[good], right[good], span[good], stamps[good]
        share = ((stamps - self.stamps[left]) / span)[:, None]
        q = so3.quat_slerp(self.q[left], self.q[right], share[:, 0])
        return Trajectory(stamps, (1.0 - share) * self.p[left] + share * self.p[right], q), good


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write `stamp [s] x y z qx qy qz qw`, one pose a line."""
    rows = zip(trajectory.stamps.tolist(), np.hstack([trajectory.p, trajectory.q]).tolist())
    path.write_text("# stamp [s] x y z [m] qx qy qz qw\n"
                    + "".join(f"{stamp // 10**9}.{stamp % 10**9:09d} {' '.join(f'{x:.9f}' for x in row)}\n" for stamp, row in rows))


def read_truth(recording: Recording, given: str | None) -> Trajectory | None:
    """Read the true motion of a recording.

    Args:
        recording: the recording.
        given: a file in TUM's or EuRoC's format, or a topic of the bag; None: the recording's own truth, also that of the simulator.

    Returns:
        The motion of the IMU's axes; None if there is none.

    Raises:
        RecordingError: it cannot be read.
    """
    if given is None and isinstance(recording, BagRecording) and recording.truth_topic:
        body, imu = read_truth(recording, recording.truth_topic), recording.sensors.imu if recording.sensors else None
        return body.turned(so3.quat_from_matrix(imu.R_BI)) if body and imu else body
    if given is None:
        file = recording.truth
        if file is None:
            return None
        T_SI = np.linalg.inv(in_body(file.with_name("sensor.yaml"))) @ in_body(file.parent.with_name("imu0") / "sensor.yaml")
        return read_trajectory(file).turned(so3.quat_from_matrix(T_SI[:3, :3]), T_SI[:3, 3])
    if Path(given).is_file():
        return read_trajectory(Path(given))
    if isinstance(recording, BagRecording) and given.startswith("/"):
        rows = recording.poses(given)
        return _validated(f"{recording.path}: {given}", np.array([row[0] for row in rows], np.int64), np.array([row[1:] for row in rows], float))
    raise RecordingError(f"--truth {given}: is no file{', and no topic' if isinstance(recording, BagRecording) else ''}")


def read_trajectory(path: Path) -> Trajectory:
    """A file in TUM's format (seconds, x y z, qx qy qz qw) or in EuRoC's (nanoseconds, x, y, z, qw, qx, qy, qz, ...).

    Raises:
        RecordingError: it cannot be read, or is neither.
    """
    lines = rows_of(path)
    if lines and "," in lines[0]:
        stamps, values = table(path, 8)
        values = values[:, [0, 1, 2, 4, 5, 6, 3]]
    else:
        rows = [line.split() for line in lines]
        try:
            stamps = np.array([_nanoseconds(row[0]) for row in rows], np.int64)
            values = np.array([row[1:8] for row in rows], float)
        except (ValueError, IndexError, ArithmeticError):
            raise RecordingError(f"{path}: is no trajectory: neither TUM's (stamp [s] x y z qx qy qz qw) nor EuRoC's format") from None
    return _validated(str(path), stamps, values)


def _nanoseconds(text: str) -> int:
    """Convert seconds to whole nanoseconds; large values in exponent notation are nanoseconds, as in some files of OpenVINS."""
    value = Decimal(text)
    return int(value if "e" in text.lower() and value > 1e14 else value * 10**9)


def _validated(source: str, stamps: np.ndarray, values: np.ndarray) -> Trajectory:
    """Check poses; return them in the order of their stamps, each stamp once, with unit quaternions."""
    if values.ndim != 2 or values.shape[1] != 7 or len(stamps) < 2:
        raise RecordingError(f"{source}: is no trajectory of two poses or more")
    stamps, order = np.unique(stamps, return_index=True)
    values = values[order]
    finite = np.isfinite(values).all(axis=1)
    stamps, values, norms = stamps[finite], values[finite], np.linalg.norm(values[finite, 3:], axis=1)
    if not len(norms) or np.abs(norms - 1.0).max() > 0.01:
        raise RecordingError(f"{source}: columns 5 to 8 are no unit quaternions")
    return Trajectory(stamps, values[:, :3], values[:, 3:] / norms[:, None])

