"""Static transforms between frames, collected from `/tf_static`."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.values import Transform, limits

BASE = "base_link"
FRAMES_MAX = 1000  # greatest number of frames


class StaticTransforms:
    """A tree of frames, each with its pose in its parent."""

    def __init__(self) -> None:
        self._poses: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}  # child -> parent, p, R

    def add(self, transform: Transform) -> str:
        """Add a transform; it replaces an earlier one of the same child.

        Returns:
            Why it cannot be used; empty if it has been added.
        """
        name = f"transform {transform.parent!r} -> {transform.child!r}"
        if problem := limits.problem(transform):
            return f"{name}: {problem}"
        if not transform.parent or not transform.child or transform.parent == transform.child:
            return f"{name} does not name two frames"
        if len(self._poses) >= FRAMES_MAX and transform.child not in self._poses:
            return f"{name}: more than {FRAMES_MAX} frames"
        q = np.array(transform.q) / np.linalg.norm(transform.q)
        self._poses[transform.child] = transform.parent, np.array(transform.p, float), so3.quat_to_matrix(q)
        return ""

    def pose(self, child: str, parent: str = BASE) -> tuple[np.ndarray, np.ndarray] | None:
        """Position (3,) [m] and attitude (3, 3) of `child` in `parent`; None if the frames are not connected."""
        up, down = self._to_root(child), self._to_root(parent)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            return None
        (p_RC, R_RC), (p_RP, R_RP) = up[common], down[common]
        return R_RP.T @ (p_RC - p_RP), R_RP.T @ R_RC

    def _to_root(self, frame: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return the pose of `frame` in itself and in each of its ancestors, nearest first."""
        p, R = np.zeros(3), np.eye(3)
        poses = {frame: (p, R)}
        while frame in self._poses:
            frame, p_step, R_step = self._poses[frame]
            if frame in poses:
                break  # a loop
            p, R = p_step + R_step @ p, R_step @ R
            poses[frame] = p, R
        return poses
