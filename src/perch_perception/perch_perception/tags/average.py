"""Target pose by the paper's method: the mean of the four tags' own poses, with their flips resolved. [M:sec. IV-B]

"We average the tags' position and quaternions to obtain the target center position and orientation." A plain average is
12-20 deg off at the 90th percentile at 3 m, since each tag's pose has two branches; the combination of branches that
agrees best is therefore chosen first.
"""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.camera import Camera
from perch_perception.tags.pose import BoardPose, LocalizationRefusal, intrinsics_sensitivity, planar_branches, reprojection_rms


def average_board(camera: Camera, corners_S: np.ndarray, rays_C: np.ndarray, ids: tuple[int, ...]) -> BoardPose:
    """Return the average of the single-tag poses. [M:sec. IV-B]

    Args:
        camera: the lens, for the residual and its errors' effect.
        corners_S: corners of the n tags in S, shape (n, 4, 3) [m].
        rays_C: measured rays of the corners, shape (n, 4, 3).
        ids: numbers of the tags, n of them.

    Returns:
        Pose of S. The covariance is the scatter of the tags' poses over n: the only uncertainty that the average provides.

    Raises:
        LocalizationRefusal: fewer than two tags, or a tag without any pose.
    """
    if len(ids) < 2:
        raise LocalizationRefusal(f"an average needs at least 2 tags, there are {len(ids)}")
    centres_S = corners_S.mean(axis=1)
    branches = []
    for corner, centre, rays, number in zip(corners_S, centres_S, rays_C, ids):
        found = planar_branches(corner - centre, rays)
        if not found:
            raise LocalizationRefusal(f"tag {number} has no pose")
        branches.append(found)
    chosen = _agreeing_branches([[R for _, R in found] for found in branches])
    p_tags = np.array([found[k][0] for found, k in zip(branches, chosen)])
    R_tags = np.array([found[k][1] for found, k in zip(branches, chosen)])
    R_CS = so3.nearest(R_tags.mean(axis=0))  # as Rotation.mean of scipy.spatial, which each node would load for 0.1 s
    p_CS = p_tags.mean(axis=0) - R_CS @ centres_S.mean(axis=0)
    # Each tag's own idea of the pose, against the average
    shift = p_tags - centres_S @ R_CS.T - p_CS
    turn = so3.log(R_tags @ R_CS.T)
    error = np.concatenate([shift, turn], axis=1)
    n = len(ids)
    # with n samples of 6 unknowns the scatter is singular: keep the variances, drop what 4 tags cannot correlate
    covariance = np.diag(np.sum(error**2, axis=0) / (n * (n - 1)))
    rms = reprojection_rms(camera, corners_S, rays_C, p_CS, R_CS)
    # the lens's errors move the average much as they move the joint solution
    by_intrinsics = intrinsics_sensitivity(camera, corners_S, np.ones(rays_C.shape[:2]), p_CS, R_CS)
    return BoardPose(p_CS, R_CS, covariance, tuple(ids), rms, by_intrinsics)


def _agreeing_branches(attitudes: list[list[np.ndarray]]) -> list[int]:
    """Return for each tag the index of its branch such that all branches agree best: every branch is tried as the reference."""
    best, choice = np.inf, [0] * len(attitudes)
    for reference in (R for found in attitudes for R in found):
        angles = [[np.arccos(np.clip(0.5 * (np.trace(R @ reference.T) - 1.0), -1.0, 1.0)) for R in found]
                  for found in attitudes]
        spread = sum(min(angle) ** 2 for angle in angles)
        if spread < best:
            best, choice = spread, [int(np.argmin(angle)) for angle in angles]
    return choice
