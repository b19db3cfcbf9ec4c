"""An estimated trajectory against the true one: ATE and RPE by `evo`, drift, and covariance against error."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_eval import consistency
from perch_eval.recordings.recording import RecordingError
from perch_eval.recordings.trajectory import Trajectory

MIN_POSES = 5
MIN_PATH = 0.1  # of a motion whose shape can be compared [m]
MAX_ALIGNMENT_ERROR = 0.2  # rotation of the aligned path due to position errors, up to which the attitude is compared [rad]


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
            nees_position_mean: mean of `nees`.
        stamps: of the compared poses [ns], shape (n,).
        error: position, estimate minus truth, in the estimate's W, with equal start positions and headings [m], shape (n, 3).
        turn: attitude error, rotation vector in W of the estimate relative to the truth, likewise [rad], shape (n, 3).
        nees: e^T P^-1 e of the position, mean 3 for a consistent filter, shape (n,); nan at the start and without covariances.
        truth_W: the true path in the estimate's W, shape (n, 3).
    """

    figures: dict[str, float]
    stamps: np.ndarray
    error: np.ndarray
    turn: np.ndarray
    nees: np.ndarray
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
    nees = np.full(len(error), np.nan)
    if covariances is not None:
        nees[1:] = consistency.nees(error[1:], covariances[kept][1:] + 1e-12 * np.eye(3))
    off = np.linalg.norm(error, axis=1)
    figures = {"compared_s": 1e-9 * float(true.stamps[-1] - true.stamps[0]), "path_m": true.length, **_evo_metrics(estimate, true),
               "final_error_m": float(off[-1]), "drift_percent": 100.0 * float(off[-1]) / true.length if true.length > MIN_PATH else np.nan,
               "largest_error_m": float(off.max()), "attitude_rms_deg": float(np.degrees(np.sqrt((turn**2).sum(axis=1).mean()))),
               "nees_position_mean": float(np.nanmean(nees)) if np.isfinite(nees).any() else np.nan}
    return Evaluation(figures, true.stamps, error, turn, nees, truth_W)


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
