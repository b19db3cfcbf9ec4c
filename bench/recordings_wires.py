"""Wires in public photographs, each scored against the reference of its repository; part of `python3 bench/recordings.py`.

Every function takes the folder of a recording and returns figures for JSON.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from perch_core.camera import Camera
from perch_eval.recordings.recording import image_files
from perch_perception.line_mapping import LineSighting
from recordings_scores import Figures, detections_in
from scipy.io import loadmat

NEAR = 8.0  # a found wire is where the reference has one within this, and the other way round [px]
WIRES_SEEN = {
    "img1": ((368, 111), (409, 99), (493, 84), (259, 205)), "img2": ((427, 297), (434, 347), (559, 216), (555, 392), (571, 413)),
    "img3": ((420, 416), (561, 229), (557, 115), (563, 197)), "img4": ((358, 258), (361, 205), (378, 145)),
    "img5": ((410, 378), (373, 212), (401, 248)), "img8": ((205, 107), (179, 156), (174, 202)),
    "img10": ((335, 123), (337, 171), (336, 196), (333, 225)), "img11": ((221, 130), (195, 110), (202, 97), (302, 170)),
    "img12": ((273, 276), (265, 304), (336, 162), (217, 203), (198, 157), (397, 124), (473, 120))}
"""A point [px] on each wire of the street's photographs that was detected and seen by eye."""


def street(folder: Path) -> Figures:
    """Count arcs in photographs of wires without a reference, and those of them that are on wires seen by eye."""
    paths = image_files(folder)
    views = [detections_in(path) for path in paths]
    seen = [_is_on(_arc(wire, view.mount.camera), WIRES_SEEN.get(path.stem, ())) for path, view in zip(paths, views) for wire in view.wires]
    return {"photographs": len(views), "arcs": len(seen), "wires": sum(seen)}


def _is_on(arc: np.ndarray, points: Sequence[tuple[int, int]]) -> bool:
    """Whether an arc of pixels (n, 2) passes within NEAR of one of the points."""
    begin, step = arc[:-1], np.diff(arc, axis=0)

    def distance(point: tuple[int, int]) -> float:
        share = np.clip(((point - begin) * step).sum(axis=1) / (step**2).sum(axis=1), 0.0, 1.0)
        return float(np.linalg.norm(begin + share[:, None] * step - point, axis=1).min())

    return any(distance(point) <= NEAR for point in points)


def traced(folder: Path) -> Figures:
    """Score photographs in `test` with wire edges traced in `test_gt`: precision and recall by length [%], within NEAR."""
    lengths = np.array([_lengths(path, folder / "test_gt" / f"{path.stem}.mat") for path in image_files(folder / "test")], float)

    def shares(rows: np.ndarray) -> np.ndarray:
        right, found, covered, wires = rows.sum(axis=0)
        return 100.0 * np.array([right / found, covered / wires])

    of_all = shares(lengths)
    change = np.max([np.abs(shares(np.delete(lengths, np.s_[k::6], axis=0)) - of_all) for k in range(6)], axis=0)
    return {"photographs": len(lengths), "precision": of_all[0], "recall": of_all[1],
            "precision_without_a_sixth": change[0], "recall_without_a_sixth": change[1]}


def _lengths(photograph: Path, reference: Path) -> tuple[int, int, int, int]:
    """Return lengths in one photograph [px]: correctly found, found, traced and found, traced."""
    view, edges = detections_in(photograph), loadmat(str(reference))["groundTruth"][0, 0]["Boundaries"][0, 0] > 0
    found = np.zeros(edges.shape, np.uint8)
    for wire in view.wires:
        cv2.polylines(found, [np.round(_arc(wire, view.mount.camera)).astype(np.int32)], False, 1)
    right = (found > 0) & (_distance(edges) <= NEAR)
    return int(right.sum()), int(found.sum()), int((edges & (_distance(found > 0) <= NEAR)).sum()), int(edges.sum())


def _arc(wire: LineSighting, camera: Camera) -> np.ndarray:
    """Pixels along an arc from one visible end to the other, shape (9, 2)."""
    first, last = sorted(wire.ends_C, key=lambda end: np.linalg.norm(end - wire.rays_C[0]))
    return camera.project(np.vstack([first, wire.rays_C, last]))[0]


def _distance(mask: np.ndarray) -> np.ndarray:
    """Return each pixel's distance from the nearest one of a mask [px]; infinite if the mask is empty."""
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) if mask.any() else np.full(mask.shape, np.inf)
