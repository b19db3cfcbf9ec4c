"""Procedural textures: blobs with edges at several scales, and the printed pad with its tags."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from perch_core.tag_board import TagBoard

MEANS = (105, 150)  # range of a texture's mean grey level under full light: walls differ
SCALES = (0.007, 0.025, 0.09, 0.35)  # sizes of the blobs [m]: some are trackable from any distance in the room
WEIGHTS = (0.8, 1.0, 1.0, 0.8)
EDGE = np.clip(np.rint(128 + 100 * np.tanh((np.arange(256) - 128) / 22.0)), 0, 255).astype(np.uint8)  # blobs get edges
WHITE, BLACK, VELCRO = 235, 20, 45  # paper, ink, hook-and-loop tape
OVERSAMPLING = 4  # of what is printed, in each direction: edges that fall between texels get their share of both


def blobs(rng: np.random.Generator, rows: int, cols: int, texel: float, contrast: float) -> np.ndarray:
    """Return a random texture with corners at every scale.

    Args:
        rng: random generator.
        rows, cols: size [texels].
        texel: size of a texel [m].
        contrast: 99 % of the texels lie within mean (1 +- contrast).

    Returns:
        uint8, shape (rows, cols).
    """
    total: np.ndarray = np.empty((rows, cols), np.uint8)
    weight_sum = 0.0
    for scale, weight in zip(SCALES, WEIGHTS):
        step = max(scale / texel, 1.5)
        small = rng.normal(128.0, 40.0, (int(rows / step) + 3, int(cols / step) + 3))
        small = np.clip(small, 0, 255).astype(np.uint8)
        layer = cv2.resize(small, (cols, rows), interpolation=cv2.INTER_CUBIC)
        cv2.LUT(layer, EDGE, dst=layer)  # in place: new pages for every layer take as long as what is done with them
        weight_sum += weight
        share = weight / weight_sum
        total = layer if share == 1.0 else cv2.addWeighted(total, 1.0 - share, layer, share, 0.0, dst=total)
    sample = total[:: max(1, rows // 256), :: max(1, cols // 256)].astype(float)
    mean = sample.mean()
    spread = max(np.percentile(np.abs(sample - mean), 99), 1.0)
    levels = rng.uniform(*MEANS) * (1.0 + contrast * np.clip((np.arange(256) - mean) / spread, -1.2, 1.2))
    return cv2.LUT(total, np.clip(np.rint(levels), 0, 255).astype(np.uint8), dst=total)


def pad(board: TagBoard, texel: float, rng: np.random.Generator) -> np.ndarray:
    """Return the pad as seen from outside, s1 up: black tags on white margins of one module, dark velcro between them.

    Args:
        board: tags that are printed.
        texel: size of a texel [m].
        rng: random generator of the velcro's fleece.

    Returns:
        uint8, shape (rows, cols): rows run along -s1, columns along -s2.
    """
    rows, cols = np.maximum(np.rint(np.array(board.pad_size) / texel).astype(int), 8)
    fleece = cv2.GaussianBlur(rng.normal(0, 60, (rows, cols)).astype(np.float32), (0, 0), 4.0)
    velcro = np.clip(VELCRO + fleece, 0, 255).astype(np.uint8)
    printed, bare = _print(board, int(rows), int(cols))
    return np.rint((printed + bare * velcro) / np.float32(OVERSAMPLING**2)).astype(np.uint8)


@lru_cache(maxsize=4)
def _print(board: TagBoard, rows: int, cols: int) -> tuple[np.ndarray, np.ndarray]:
    """Render the printed tags of a pad, which are the same in every flight.

    Returns:
        Grey levels summed over those samples of each texel that are printed, and the number of samples that are not,
        uint16 (rows, cols).
    """
    extent, shape = np.array(board.pad_size), (rows * OVERSAMPLING, cols * OVERSAMPLING)
    image, bare = np.zeros(shape, np.uint8), np.ones(shape, np.uint8)
    scale = np.array(shape[::-1]) / extent[::-1]  # samples per metre along u and v
    dictionary, modules = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{board.family}")), board.modules
    for tag, corners_S in zip(board.tags, board.corners_S):
        marker = cv2.aruco.generateImageMarker(dictionary, tag.id, modules, borderBits=board.border)  # one texel per module
        print_ = np.full((modules + 2, modules + 2), WHITE, np.uint8)
        print_[1:-1, 1:-1] = np.where(marker > 127, WHITE, BLACK)
        corners = ((extent[::-1] / 2 - corners_S[:, [1, 0]]) * scale - 0.5).astype(np.float32)
        black_border = modules * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) + np.float32(0.5)
        warp = cv2.getPerspectiveTransform(black_border, corners)
        mask = cv2.warpPerspective(np.full_like(print_, 255), warp, shape[::-1], flags=cv2.INTER_NEAREST)
        cv2.copyTo(cv2.warpPerspective(print_, warp, shape[::-1], flags=cv2.INTER_NEAREST), mask, image)
        bare[mask > 0] = 0
    if board.corner_squares and board.grid is not None:  # black, between the corners of neighbouring tags
        for tag, corners_S in zip(board.tags, board.corners_S):
            for corner in corners_S[:, :2]:
                ends = np.array([corner, corner + board.grid.spacing * tag.size * np.sign(corner - tag.centre)])
                u, v = np.sort(np.rint((extent[::-1] / 2 - ends[:, ::-1]) * scale).astype(int), axis=0).clip(0, shape[::-1]).T
                image[slice(*v), slice(*u)], bare[slice(*v), slice(*u)] = BLACK, 0
    shifts = [(a, b) for a in range(OVERSAMPLING) for b in range(OVERSAMPLING)]
    printed, paper = (np.array([samples[a::OVERSAMPLING, b::OVERSAMPLING] for a, b in shifts]).sum(axis=0, dtype=np.uint16)
                      for samples in (image, bare))
    return printed, paper
