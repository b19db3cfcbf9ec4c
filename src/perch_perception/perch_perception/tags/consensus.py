"""Selection of the sighting that belongs to the board, among several with one tag number.

Each tag alone gives a rough pose of the whole board. The sightings that are consistent with the pose which most of them support
are those of the board. This does not distinguish two identical boards: the expected one is chosen, else the one that fits better.
"""

from __future__ import annotations

import numpy as np

from perch_core.camera import Camera
from perch_perception.tags.pose import planar_branches

AGREES = 0.35  # mean distance of a sighting's corners from those expected, as a share of the tag's side


def consistent(camera: Camera, corners_S: np.ndarray, numbers: np.ndarray, corners: np.ndarray,
               expected: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """Return the indices of the sightings that show the board, each tag once.

    Args:
        camera: the lens.
        corners_S: corners of the board's n tags in S, shape (n, 4, 3) [m].
        numbers: index of the tag that each of k sightings shows, shape (k,).
        corners: pixels of their corners, shape (k, 4, 2).
        expected: pose (p_CS, R_CS) at which the board is expected.

    Returns:
        Shape (m,). Where no two sightings agree, those of the tags that are seen once.
    """
    rays = camera.unproject(corners)
    poses = [] if expected is None else [expected]
    for number, one in zip(numbers, rays):
        if np.all(np.isfinite(one)):
            centre = corners_S[number].mean(axis=0)
            poses += [(p - R @ centre, R) for p, R in planar_branches(corners_S[number] - centre, one)]
    once = np.flatnonzero(np.bincount(numbers, minlength=1)[numbers] == 1)
    choices = [(1, -np.inf, once)]
    for p, R in poses:
        pixels, valid = camera.project(corners_S @ R.T + p)
        side = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).mean(axis=1)
        away = np.linalg.norm(corners - pixels[numbers], axis=2).mean(axis=1) / side[numbers]
        near = np.flatnonzero(np.all(valid, axis=1)[numbers] & (away < AGREES))
        first = near[np.argsort(away[near], kind="stable")]
        chosen = np.sort(first[np.unique(numbers[first], return_index=True)[1]])
        choices.append((len(chosen), -float(away[chosen].mean()) if len(chosen) else -np.inf, chosen))
    if expected is not None and choices[1][0]:
        return choices[1][2]
    return max(choices, key=lambda choice: choice[:2] if choice[0] > 1 else (1, np.inf if choice[2] is once else -np.inf))[2]
