"""Trajectories over time, their files (TUM, EuRoC's ground truth), and the errors of an estimated one against the true one: ATE and
RPE by `evo`, drift, and covariance against error."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import so3
from perch_eval import consistency
from perch_eval.recordings.opening import BagRecording
from perch_eval.recordings.calibration import in_body
from perch_eval.recordings.recording import Recording, RecordingError, rows_of, table

MAX_GAP = 0.15  # poses further apart than this are not interpolated [s]
MIN_POSES = 5
MIN_PATH = 0.1  # of a motion whose shape can be compared [m]
MAX_ALIGNMENT_ERROR = 0.2  # rotation of the aligned path due to position errors, up to which the attitude is compared [rad]


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



@dataclass(frozen=True)
class Evaluation:
    """Errors of an estimated trajectory against the true one.

    Attributes:
        figures: for a table or JSON, of n poses; nan: not available.
            compared_s, path_m: duration, and length of the true path.
            ate_rmse_m: absolute trajectory error after the best rigid alignment; nan: the motion is too short to be aligned.
            ate_rmse_deg: the same of the attitude; nan also if the path is too straight for its shape to determine the attitude.
            rpe_rmse_m, rpe_rmse_deg: relative pose error over `rpe_delta_m` of path, in position and attitude; nan likewise.
            scale: of the estimate relative to the truth; nan likewise.
            final_error_m, largest_error_m, drift_percent, attitude_rms_deg: from `error` and `turn`.
            nees_position_mean: mean of e^T P^-1 e of the position, 3 for a consistent filter; nan without covariances.
        stamps: of the compared poses [ns], shape (n,).
        error: position, estimate minus truth, in the estimate's W, with equal start positions and headings [m], shape (n, 3).
        turn: attitude error, rotation vector in W of the estimate relative to the truth, likewise [rad], shape (n, 3).
        truth_W: the true path in the estimate's W, shape (n, 3).
    """

    figures: dict[str, float]
    stamps: np.ndarray
    error: np.ndarray
    turn: np.ndarray
    truth_W: np.ndarray


def evaluate(estimate: Trajectory, truth: Trajectory, covariances: np.ndarray | None = None) -> Evaluation:
    """Compare an estimate with the truth.

    Args:
        estimate: n poses.
        truth: poses of the same body, at any stamps of the same clock.
        covariances: of the estimate's position in its W [m^2], shape (n, 3, 3).

    Raises:
        RecordingError: fewer than `MIN_POSES` poses have a true pose at their stamp.
    """
    true, kept = truth.at(estimate.stamps)
    if kept.sum() < MIN_POSES:
        raise RecordingError(f"the truth ({_span(truth)}) and the estimate ({_span(estimate)}) have {int(kept.sum())} stamps in common")
    estimate = estimate.chosen(kept)
    # both begin in the same place with the same heading: what VIO cannot know is taken away, tilt is left
    turn0 = so3.quat_to_matrix(estimate.q[0]) @ so3.quat_to_matrix(true.q[0]).T
    R = so3.exp(np.array([0.0, 0.0, np.arctan2(turn0[1, 0] - turn0[0, 1], turn0[0, 0] + turn0[1, 1])]))
    truth_W = (true.p - true.p[0]) @ R.T + estimate.p[0]
    error = estimate.p - truth_W
    turn = so3.quat_log(so3.quat_multiply(estimate.q, so3.quat_conjugate(so3.quat_multiply(so3.quat_from_matrix(R), true.q))))
    nees = np.nan if covariances is None else float(consistency.nees(error[1:], covariances[kept][1:] + 1e-12 * np.eye(3)).mean())
    off = np.linalg.norm(error, axis=1)
    figures = {"compared_s": 1e-9 * float(true.stamps[-1] - true.stamps[0]), "path_m": true.length, **_evo_metrics(estimate, true),
               "final_error_m": float(off[-1]), "drift_percent": 100.0 * float(off[-1]) / true.length if true.length > MIN_PATH else np.nan,
               "largest_error_m": float(off.max()), "attitude_rms_deg": float(np.degrees(np.sqrt((turn**2).sum(axis=1).mean()))),
               "nees_position_mean": nees}
    return Evaluation(figures, true.stamps, error, turn, truth_W)


def _evo_metrics(estimate: Trajectory, true: Trajectory) -> dict[str, float]:
    """Return ATE, RPE and scale as in `Evaluation.figures`; nan if the motion is too short."""
    from evo.core import metrics
    from evo.core.geometry import GeometryException
    from evo.core.metrics import MetricsException, PoseRelation, Unit
    from evo.core.trajectory import PoseTrajectory3D

    def to_evo(t: Trajectory) -> PoseTrajectory3D:
        return PoseTrajectory3D(t.p.copy(), t.q[:, [3, 0, 1, 2]].copy(), 1e-9 * (t.stamps - true.stamps[0]))

    def rms(metric: metrics.PE, ours: PoseTrajectory3D) -> float:
        metric.process_data((to_evo(true), ours))
        return float(metric.get_statistic(metrics.StatisticsType.rmse))

    delta, ours = max(0.1, round(0.1 * true.length, 1)), to_evo(estimate)
    found = dict.fromkeys(("ate_rmse_m", "ate_rmse_deg", "rpe_rmse_m", "rpe_rmse_deg"), np.nan) | {"rpe_delta_m": delta, "scale": np.nan}
    if true.length < MIN_PATH:
        return found
    with suppress(GeometryException):  # along a line, or on the spot
        scale = float(to_evo(estimate).align(to_evo(true), correct_scale=True)[2])
        ours.align(to_evo(true))
        found |= {"ate_rmse_m": rms(metrics.APE(PoseRelation.translation_part), ours), "scale": 1.0 / scale if scale else np.nan}
        if found["ate_rmse_m"] < MAX_ALIGNMENT_ERROR * _breadth(true.p):
            found["ate_rmse_deg"] = rms(metrics.APE(PoseRelation.rotation_angle_deg), ours)
    with suppress(MetricsException):
        found["rpe_rmse_m"], found["rpe_rmse_deg"] = (
            rms(metrics.RPE(relation, delta, Unit.meters, rel_delta_tol=0.2, all_pairs=True, pairs_from_reference=True), to_evo(estimate))
            for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg))
    return found


def _breadth(p: np.ndarray) -> float:
    """Return the rms distance of positions (n, 3) from their best-fitting straight line [m].

    A rotation about that line by delta moves them by delta times this, so rms errors e leave it uncertain by e / breadth.
    """
    spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    return float(np.hypot(spread[1], spread[2]) / np.sqrt(len(p)))


def _span(trajectory: Trajectory) -> str:
    return f"{1e-9 * trajectory.stamps[0]:.2f} to {1e-9 * trajectory.stamps[-1]:.2f} s" if len(trajectory) else "no pose"
