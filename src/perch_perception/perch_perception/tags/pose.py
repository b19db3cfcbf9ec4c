"""Pose of the board from the corners of all its visible tags together: one PnP in the fisheye model.

A single small square has two nearly equally good poses (the IPPE ambiguity): averages over single-tag poses flip and
are 12-20 deg off at 3 m. All corners together, over the pad's 0.56 m, have one clear minimum.

The least squares over the corners, with the errors of lens and print, are in `corners.py`.

Errors of a pose T_AB = (p_AB, R_AB) are (dp, dtheta) in the axes of A: p = p^ + dp, R = exp(dtheta) R^. This is also the
convention of geometry_msgs/PoseWithCovariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from perch_core import so3
from perch_core.camera import Camera
from perch_core.errors import PerchError
from perch_perception.tags.corners import EXACT_LENS, Corners, limit, refine

SAME_POSE = np.radians(0.5)        # branches closer than this are one and the same minimum [rad]
PRIOR_SIGMA = np.radians(10.0)     # how far the attitude may have turned since it was predicted [rad]
MODEL_SHARE = 0.02                 # print, paper and lens put corners where they belong within this share of the tag's longest side
OUTLIER = 10.0                     # a tag that is so many times less consistent than the others is not where it should be
SUSPECTS = 4                       # tags that are tried one by one as the one that is not


class LocalizationRefusal(PerchError):
    """Raised when the corners do not determine the pose of the board; the message gives the reason."""


@dataclass(frozen=True)
class BoardPose:
    """Pose of the surface frame S in the camera C.

    Attributes:
        p_CS: position of S [m], shape (3,).
        R_CS: attitude of S, shape (3, 3).
        covariance: of (dp, dtheta) in the axes of C [m, rad], shape (6, 6), from noise and print but not from the lens.
        ids: tags used.
        rms: residual of the corners, per image axis [px].
        misfit: chi^2 over the degrees of freedom, 1 where the corners are off by their sigmas.
        unexplained: mean square of the residuals that neither pose nor lens explains, where it is more than chance; else 1.
        by_intrinsics: derivative of (dp, dtheta) by errors of the lens's fx, fy (relative) and cx, cy [px], which the
            solution does not estimate, shape (6, 4).
        branch_gap: excess of chi^2 of the second-best pose over that of the best; inf where there is only one.
        dropped: tags left out as they contradict the others.
    """

    p_CS: np.ndarray
    R_CS: np.ndarray
    covariance: np.ndarray
    ids: tuple[int, ...]
    rms: float
    by_intrinsics: np.ndarray
    branch_gap: float = np.inf
    dropped: tuple[int, ...] = ()
    misfit: float = 1.0
    unexplained: float = 1.0


def solve_board(camera: Camera, corners_S: np.ndarray, rays_C: np.ndarray, sigma: np.ndarray, ids: tuple[int, ...],
                prior_R_CS: np.ndarray | None = None, start: tuple[np.ndarray, np.ndarray] | None = None,
                lens_sigma: np.ndarray = EXACT_LENS, print_sigma: float = 0.0) -> BoardPose:
    """Solve for the joint pose over all corners; a tag that contradicts the others is left out.

    Args:
        camera: the lens; residuals are formed in its pixels.
        corners_S: corners of the n tags in S, shape (n, 4, 3) [m], all in the plane z_S = 0.
        rays_C: measured rays, shape (n, 4, 3).
        sigma: 1-sigma of the corners [px], shape (n, 4).
        ids: numbers of the tags, n of them.
        prior_R_CS: predicted attitude; only helps to choose between two minima.
        start: predicted (p_CS, R_CS) of a board whose pose was unique: no second minimum is then searched for.
        lens_sigma: 1-sigma of the lens's fx, fy (relative), cx, cy [px], shape (4,).
        print_sigma: 1-sigma of a tag's place on the board, in each direction of its plane [m].

    Raises:
        LocalizationRefusal: a corner lies beyond the lens, no pose shows the front of the board, or the corners fit none.
    """
    keep, dropped = np.arange(len(ids)), list[int]()
    best = _solve(camera, corners_S, rays_C, sigma, ids, lens_sigma, print_sigma, prior_R_CS, start)
    # of two tags that disagree, either may be wrong
    while best.misfit > limit(_freedom(len(keep))) and len(keep) >= 3 and 2 * len(dropped) < len(ids) - 2:
        if best.misfit * _freedom(len(keep)) < 8.0 * OUTLIER:
            break  # no tag's leaving could explain so much
        expected, seen = camera.project(corners_S[keep] @ best.R_CS.T + best.p_CS)[0], camera.project(rays_C[keep])[0]
        off = np.linalg.norm(expected - seen, axis=2) / sigma[keep]
        trials = []
        for out in np.argsort(-np.nan_to_num(off, nan=np.inf).max(axis=1))[:SUSPECTS]:
            rest = np.delete(keep, out)
            some = tuple(ids[k] for k in rest)
            trial = _solve(camera, corners_S[rest], rays_C[rest], sigma[rest], some, lens_sigma, print_sigma, prior_R_CS, start)
            trials.append((trial, keep[out], rest))
        trial, out, rest = min(trials, key=lambda trial: trial[0].misfit)
        explained = best.misfit * _freedom(len(keep)) - trial.misfit * _freedom(len(rest))
        if explained / 8.0 < OUTLIER * max(trial.misfit, 1.0):
            break
        best, keep = trial, rest
        dropped.append(ids[out])
    pixels = camera.project(rays_C[keep])[0]
    model = MODEL_SHARE * np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).max(axis=1, keepdims=True)
    if best.misfit > limit(_freedom(len(keep))) * float(np.mean(1.0 + (model / sigma[keep]) ** 2)):
        raise LocalizationRefusal(f"tags {list(ids)} do not fit the board: residual {best.rms:.2f} px RMS")
    if best.unexplained > 1.0:
        noise = sigma[keep] * np.sqrt(best.unexplained)
        again = _solve(camera, corners_S[keep], rays_C[keep], noise, best.ids, lens_sigma, print_sigma, prior_R_CS, start)
        best = replace(again, misfit=best.misfit)
    return replace(best, dropped=tuple(sorted(dropped)))


def _freedom(tags: int) -> int:
    return 8 * tags - 6


def _solve(camera, corners_S, rays_C, sigma, ids, lens_sigma, print_sigma, prior_R_CS, start=None) -> BoardPose:
    """Return the best of the two IPPE branches, or the start alone, after refinement."""
    points, rays = corners_S.reshape(-1, 3), rays_C.reshape(-1, 3)
    pixels, seen = camera.project(rays)
    if not np.all(seen):
        raise LocalizationRefusal("a corner lies beyond the lens's field of view")
    corners = Corners(camera, points, sigma.reshape(-1), pixels, lens_sigma, print_sigma)
    branches = []
    for p, R in [start] if start is not None else planar_branches(points, rays):
        corners.start(p, R)
        refined = refine(corners, p, R)
        if refined is None or refined[0][2] <= 0.0 and camera.max_angle <= np.pi / 2:
            continue
        p, R, chi_square = refined
        if R[:, 2] @ p >= 0.0:
            continue  # the back of the board
        cost = chi_square
        if prior_R_CS is not None:
            cost += (np.linalg.norm(so3.log(R @ prior_R_CS.T)) / PRIOR_SIGMA) ** 2
        branches.append((cost, chi_square, p, R))
    if not branches:
        raise LocalizationRefusal(f"tags {list(ids)}: no pose shows the front of the board")
    branches.sort(key=lambda branch: branch[0])
    cost, chi_square, p, R = branches[0]
    covariance, by_intrinsics = corners.errors(p, R)
    covariance = covariance * max(1.0, chi_square / _freedom(len(ids)))
    gap = np.inf
    if len(branches) > 1:
        turn = so3.log(branches[1][3] @ R.T)
        if np.linalg.norm(turn) > SAME_POSE:
            # Two minima: the covariance of the mixture says how sure the choice is.
            gap = (branches[1][0] - cost) / max(1.0, chi_square / _freedom(len(ids)))
            apart = np.concatenate([branches[1][2] - p, turn])
            share = 1.0 / (1.0 + np.exp(min(0.5 * gap, 500.0)))
            covariance = (1.0 - share) * covariance + share * (corners.errors(*branches[1][2:])[0] + np.outer(apart, apart))
    return BoardPose(p, R, covariance, tuple(ids), corners.rms(p, R), by_intrinsics, float(gap),
                     misfit=chi_square / _freedom(len(ids)), unexplained=corners.unexplained(p, R))


def planar_branches(points_S: np.ndarray, rays_C: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the up to two poses of a planar target that IPPE finds, best first, as (p_CS, R_CS); none where a ray is 87 deg or more from their mean.

    Args:
        points_S: coplanar points with z_S = 0, shape (k, 3), k >= 4.
        rays_C: their unit rays, shape (k, 3); they are transformed to a pinhole aimed at their mean, so any lens is supported.
    """
    z = rays_C.mean(axis=0)
    z /= np.linalg.norm(z)
    x = so3.cross(np.eye(3)[1 if abs(z[1]) < 0.9 else 0], z)
    x /= np.linalg.norm(x)
    R_CV = np.stack([x, so3.cross(z, x), z], axis=1)
    rays_V = rays_C @ R_CV
    if np.any(rays_V[:, 2] < 0.05):
        return []
    plane = np.ascontiguousarray(rays_V[:, :2] / rays_V[:, 2:]).reshape(-1, 1, 2)
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        np.ascontiguousarray(points_S), plane, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return [(R_CV @ shifts[i].ravel(), R_CV @ cv2.Rodrigues(turns[i])[0]) for i in range(count)
            if np.all(np.isfinite(turns[i])) and np.all(np.isfinite(shifts[i]))]


def intrinsics_sensitivity(camera: Camera, corners_S: np.ndarray, sigma: np.ndarray, p_CS: np.ndarray,
                           R_CS: np.ndarray) -> np.ndarray:
    """Derivative of (dp, dtheta) of the least-squares pose by the true lens's fx, fy (relative), cx, cy [px], shape (6, 4)."""
    points = corners_S.reshape(-1, 3)
    pixels = camera.project(points @ R_CS.T + p_CS)[0]
    return Corners(camera, points, sigma.reshape(-1), pixels, EXACT_LENS).errors(p_CS, R_CS)[1]


def reprojection_rms(camera: Camera, corners_S: np.ndarray, rays_C: np.ndarray, p_CS: np.ndarray,
                     R_CS: np.ndarray) -> float:
    """Residual of measured corners (n, 4, 3) against a pose, per image axis [px]; inf where one leaves the lens."""
    projected, seen = camera.project(corners_S @ R_CS.T + p_CS)
    residual = projected - camera.project(rays_C)[0]
    return float(np.sqrt(np.mean(residual**2))) if np.all(seen) else np.inf
