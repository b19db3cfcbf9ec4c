"""Visibility of the target line along a manoeuvre: the measures of the paper's Fig. 7. [P:eq9, P:eq12, P:eq13]"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core import lines, so3
from perch_core.camera_mount import CameraMount
from perch_core.components import components
from perch_core.rotor_model import P, Q

SAMPLES = 41  # points along the segment for `in_image`


@dataclass(frozen=True)
class Visibility:
    """Line metrics along a trajectory.

    Attributes:
        reprojection: distance of the line from the image centre [px], shape (m,), limited to that of the image's corners, which also
            counts for a line behind the camera. [P:eq9]
        cheirality: h_lc > 0: the line is in front, shape (m,). [P:eq12]
        segment: the segment is at the centre, shape (m,). [P:eq13]
        in_image: share of the segment's sample points inside the image, shape (m,).
        corner: distance of the image's corners from its centre [px].
    """

    reprojection: np.ndarray
    cheirality: np.ndarray
    segment: np.ndarray
    in_image: np.ndarray
    corner: float

    def summary(self) -> dict[str, float]:
        """Shares of the time and the mean reprojection error."""
        return {
            "cheirality_share": float(self.cheirality.mean()),
            "segment_share": float((self.segment & self.cheirality).mean()),
            "mean_reprojection_px": float(self.reprojection.mean()),
            "seen_share": float((self.in_image > 0).mean()),
        }


def visibility(states: np.ndarray, line: lines.Segment, mount: CameraMount) -> Visibility:
    """Line metrics of the states of a trajectory.

    Args:
        states: shape (m, 17).
        line: the target.
        mount: camera and its place on the body.
    """
    fx, fy = float(mount.camera.K[0, 0]), float(mount.camera.K[1, 1])
    p_WB, q_WB = components(states[:, P]), components(states[:, Q])
    o_C, l_C = lines.line_in_camera(p_WB, q_WB, components(line.centre), components(line.direction),
                                    components(mount.p_BC), components(so3.quat_from_matrix(mount.R_BC)))
    n_I, l_I = lines.image_line(o_C, l_C, fx, fy)
    place, depth = lines.segment_place(*lines.image_line(o_C, l_C), o_C, line.half_length)
    points_W = line.centre + np.linspace(-line.half_length, line.half_length, SAMPLES)[:, None] * line.direction
    in_image = np.empty(len(states))
    for k, state in enumerate(states):
        R_WC = so3.quat_to_matrix(state[Q]) @ mount.R_BC
        points_C = (points_W - state[P] - so3.quat_to_matrix(state[Q]) @ mount.p_BC) @ R_WC
        pixels, valid = mount.camera.project(points_C)
        inside = valid & (pixels >= 0).all(axis=1) & (pixels[:, 0] < mount.camera.width) & (pixels[:, 1] < mount.camera.height)
        in_image[k] = inside.mean()
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(lines.reprojection_error(n_I))
    front, corner = lines.cheirality(n_I, l_I) > 0, float(np.hypot(mount.camera.width, mount.camera.height)) / 2
    return Visibility(np.where(front, np.fmin(error, corner), corner), front, np.abs(place) < np.abs(depth), in_image, corner)
