"""Detection of wires in an image as arcs on the sphere of rays.

A straight wire is seen as a plane through the optical centre, under any lens; one that sags, as an arc near a plane. Each blob of
pixels with high redness R - max(G, B) is therefore reduced to ridge points, these are converted to rays, and parabolas about the
blob's plane are fitted to them. The threshold on redness gives no false segments on a textured background, where a line detector
on the red channel gave thousands. Wires without a colour are ridges that run straight through the image (see `straight`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from perch_core import config
from perch_core.camera import Camera
from perch_perception.line_mapping.centring import centred
from perch_perception.line_mapping.ridges import ridges
from perch_perception.line_mapping.straight import wires

RED_LENGTH, PLAIN_LENGTH = 30.0, 80.0  # shorter arcs are no wires [px]
TOLERANCE = 1.5  # of ridge points from their arc [px]
SIGMA = 0.2  # error of an arc that averaging does not remove [px]
MAX_GAP = 25.0  # hole after which an arc is another one [px]
MIN_WIDTH = 4.0  # the width of a thinner wire cannot be measured [px]
SAMPLES = 7          # rays that stand for a sighting
HYPOTHESES = 64      # arcs tried per blob and round
MAX_BEND = 0.6       # second derivative of an arc: a wire bends no more [1/rad]
EDGE_REACH = 4       # a run's edge is sought among so many steps and one, from one outside to three inside [px]
MAX_LINES = 6        # lines in one blob: cables that cross in the image share one
WIDTH_LOSS = 0.5     # a wire wider than 6 px looks narrower by this: blurred, and darker at its rims [px]
# In a wire of a few pixels the blurred edges meet and push each other outward again: the loss is smaller by MEETING at MEETING_AT,
# e times less per MEETING_OVER. From a round wire, 0.6 as bright at its rim as in its middle, under a blur of 1.2 px [px]
MEETING, MEETING_AT, MEETING_OVER = 0.4, 3.25, 1.1


@dataclass(frozen=True)
class LineDetectionConfig:
    """Settings of the wire detection."""

    appearance: str = config.choice("red", options=("red", "plain"),
                                    doc="red: redder than everything else; plain: brighter or darker than what is behind it")
    redness: float = config.quantity(20.0, low=1.0, high=255.0, doc="least R - max(G, B) of a red wire [grey values]")


@dataclass(frozen=True)
class LineSighting:
    """One arc of a straight wire in one image.

    Attributes:
        rays_C: unit rays to its axis in C, in order along it, shape (7, 3).
        ends_C: rays to its visible ends, shape (2, 3).
        sigma: 1-sigma of a ray across the arc [rad].
        width: angle between the planes through the optical centre that touch the wire [rad]; 0 where it was not measured.
        length: in the image [px].
    """

    rays_C: np.ndarray
    ends_C: np.ndarray
    sigma: float
    width: float
    length: float


def redness(image: np.ndarray) -> np.ndarray:
    """R - max(G, B) of an rgb8 image (h, w, 3), not below 0, slightly smoothed, uint8 (h, w)."""
    r, g, b = cv2.split(image)
    return cv2.GaussianBlur(cv2.subtract(r, cv2.max(g, b)), (0, 0), 1.0)


def detect_lines(image: np.ndarray, camera: Camera, settings: LineDetectionConfig) -> list[LineSighting]:
    """Return the wires in an image, the longest first.

    Args:
        image: rgb8, shape (height, width, 3); for plain wires mono8, shape (height, width), too.
        camera: its lens.
        settings: criteria for a wire.
    """
    if settings.appearance == "plain":
        return _plain(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), camera)
    strength = redness(image)
    red = (strength > settings.redness).astype(np.uint8)
    mask = cv2.morphologyEx(red, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    padded = np.pad(strength.astype(float), EDGE_REACH, constant_values=np.nan)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    sightings = []
    for label in range(1, count):
        x, y, w, h = stats[label, :4]
        if max(w, h) < RED_LENGTH:
            continue
        window = slice(y, y + h), slice(x, x + w)
        around = padded[y:y + h + 2 * EDGE_REACH, x:x + w + 2 * EDGE_REACH]
        pixels, edges = ridge_points(np.where(labels[window] == label, strength[window], 0).astype(float), around)
        sightings += _arcs(pixels + (x, y), edges + (x, y), camera)
    return sorted(sightings, key=lambda sighting: -sighting.length)


def _plain(grey: np.ndarray, camera: Camera) -> list[LineSighting]:
    """Return the wires without a distinctive colour; their widths are not measured."""
    found = ridges(grey)
    rays, edges = camera.unproject(found.pixels), np.full((len(found.pixels), 2, 2), np.nan)
    arcs = wires(found, camera, TOLERANCE, PLAIN_LENGTH)
    sightings = []
    for arc in arcs:
        one = _sighting(arc.points, found.pixels, edges, rays, arc.scatter / camera.fx, camera)
        sightings.append(replace(one, rays_C=centred(grey, camera, one.rays_C, arc.bright, arc.level)))
    return sorted(sightings, key=lambda sighting: -sighting.length)


def ridge_points(blob: np.ndarray, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle and edges of every run of pixels across a blob.

    Args:
        blob: weights, 0 outside the blob, shape (h, w).
        around: weights of the blob and its surroundings, nan beyond the image, shape (h + 2 EDGE_REACH, w + 2 EDGE_REACH).

    Returns:
        Pixels (n, 2), and where the runs begin and end (n, 2, 2), nan where that is beyond the image.
    """
    upright = blob.shape[0] > blob.shape[1]  # scan across the longer side
    across = blob.T if upright else blob
    inside = np.zeros((across.shape[0] + 2, across.shape[1]), np.int8)
    inside[1:-1] = across > 0
    edge = np.diff(inside, axis=0).T
    column, first = np.nonzero(edge == 1)  # row-major in the transposed array: runs in order, column by column
    _, last = np.nonzero(edge == -1)
    sums = np.zeros((2, across.shape[0] + 1, across.shape[1]))
    sums[0, 1:] = np.cumsum(across, axis=0)
    sums[1, 1:] = np.cumsum(across * np.arange(across.shape[0])[:, None], axis=0)
    weight, moment = (sums[k, last, column] - sums[k, first, column] for k in (0, 1))
    at = [moment / weight, *_edges((around.T if upright else around)[:, EDGE_REACH:-EDGE_REACH], column, first, last)]
    pixels, begin, end = (np.stack([k, column] if upright else [column, k], axis=-1).astype(float) for k in at)
    return pixels, np.stack([begin, end], axis=1)


def _edges(around: np.ndarray, column: np.ndarray, first: np.ndarray, last: np.ndarray) -> list[np.ndarray]:
    """Return where runs begin and end, (n,) each: at the steepest places, which neither blur nor shading moves."""
    steps = np.diff(around, axis=0)  # from row k - EDGE_REACH to the next: at k - EDGE_REACH + 1/2
    found, run = [], np.arange(len(column))
    for sign, outside in ((1.0, first - 2), (-1.0, last - EDGE_REACH)):
        rows = outside[:, None] + np.arange(EDGE_REACH + 1)
        slope = sign * steps[rows + EDGE_REACH, column[:, None]]
        top = np.clip(np.argmax(slope, axis=1), 1, EDGE_REACH - 1)
        before, peak, after = (slope[run, top + k] for k in (-1, 0, 1))
        bend = np.minimum(before - 2.0 * peak + after, -1e-9)
        found.append(rows[run, top] + 0.5 + np.clip(0.5 * (before - after) / bend, -1.0, 1.0))
    return found


def _arcs(pixels, edges, camera) -> list[LineSighting]:
    """Return the arcs through the ridge points of one blob, the best first, each split where it has gaps."""
    rays = camera.unproject(pixels)
    seen = np.all(np.isfinite(rays), axis=1) & np.all(np.isfinite(edges), axis=(1, 2))  # the middle of what the image cuts off is not the wire's
    pixels, edges, rays = pixels[seen], edges[seen], rays[seen]
    if len(rays) < RED_LENGTH:
        return []
    along, across = _arc_coordinates(rays)
    rng = np.random.default_rng(len(pixels))  # the same image gives the same arcs
    left = np.arange(len(pixels))
    sightings: list[LineSighting] = []
    for _ in range(MAX_LINES):
        if len(left) < RED_LENGTH:
            break
        inlier, spread = _best_arc(along[left], across[left], rng, TOLERANCE / camera.fx)
        if inlier.sum() < RED_LENGTH:
            break
        chosen = left[inlier]
        chosen = chosen[np.argsort(along[chosen], kind="stable")]
        for piece in _pieces(chosen, pixels):
            sightings.append(_sighting(piece, pixels, edges, rays, spread, camera))
        left = left[~inlier]
    return sightings


def _arc_coordinates(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles along and across the plane through the origin that is nearest to rays (n, 3) [rad]."""
    normal = np.linalg.eigh(rays.T @ rays)[1][:, 0]
    forward = rays.mean(axis=0)
    forward = forward - (forward @ normal) * normal
    forward /= np.linalg.norm(forward)
    return np.arctan2(rays @ np.cross(normal, forward), rays @ forward), np.arcsin(np.clip(rays @ normal, -1.0, 1.0))


def _best_arc(along: np.ndarray, across: np.ndarray, rng: np.random.Generator, tolerance: float
              ) -> tuple[np.ndarray, float]:
    """Inliers (n,) of the parabola through most points, by RANSAC and two refits, and their scatter [rad]."""
    none = np.zeros(len(along), bool), 0.0
    triples = rng.integers(0, len(along), (HYPOTHESES, 3))
    t = along[triples]
    apart = np.abs(t - np.roll(t, 1, axis=1)).min(axis=1) > 0.05 * np.ptp(along)
    if not apart.any():
        return none
    arcs = np.linalg.solve(_powers(t[apart]), across[triples[apart]][..., None])[..., 0]
    arcs = arcs[np.abs(2.0 * arcs[:, 2]) < MAX_BEND]
    if len(arcs) == 0:
        return none
    sparse = slice(None, None, max(1, len(along) // 200))
    misfit = np.abs(_powers(along[sparse]) @ arcs.T - across[sparse, None])
    arc = arcs[np.argmax((misfit < tolerance).sum(axis=0))]
    for _ in range(2):
        inlier = np.abs(_powers(along) @ arc - across) < tolerance
        if inlier.sum() < 3:
            return none
        arc = np.linalg.lstsq(_powers(along[inlier]), across[inlier], rcond=None)[0]
    rest = _powers(along) @ arc - across
    inlier = np.abs(rest) < tolerance
    return inlier, float(np.std(rest[inlier])) if inlier.any() else 0.0


def _powers(t: np.ndarray) -> np.ndarray:
    """1, t, t^2 on a new last axis."""
    return np.stack([np.ones_like(t), t, t * t], axis=-1)


def _pieces(ordered: np.ndarray, pixels: np.ndarray) -> list[np.ndarray]:
    """Indices of the points of each unbroken piece of an arc, in order along it."""
    steps = np.linalg.norm(np.diff(pixels[ordered], axis=0), axis=1)
    pieces = np.split(ordered, np.nonzero(steps > MAX_GAP)[0] + 1)
    return [p for p in pieces if len(p) >= 2 * SAMPLES
            and np.linalg.norm(pixels[p[-1]] - pixels[p[0]]) >= RED_LENGTH]


def _sighting(piece, pixels, edges, rays, spread, camera) -> LineSighting:
    groups = np.array_split(piece, SAMPLES)
    means = np.array([rays[group].mean(axis=0) for group in groups])
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    length = float(np.linalg.norm(pixels[piece[-1]] - pixels[piece[0]]))
    sigma = np.hypot(spread / np.sqrt(len(piece) / SAMPLES), SIGMA / camera.fx)
    return LineSighting(means, rays[piece[[0, -1]]], float(sigma), _width(edges[piece], camera), length)


def _width(edges: np.ndarray, camera: Camera) -> float:
    """Angle between the planes that touch a wire on both sides [rad], from its edges in the image (n, 2, 2).

    In an oblique view the wire's direction differs from that of its image, so a plane is fitted to each side. 0 where an edge is
    unknown (nan) or beyond the lens's calibration, or the wire is too thin to be measured.
    """
    if np.isnan(edges).any():
        return 0.0
    normals = []
    for side in (0, 1):
        rays = camera.unproject(edges[:, side])
        if not np.isfinite(rays).all():
            return 0.0
        normal = np.linalg.eigh(rays.T @ rays)[1][:, 0]
        off = np.abs(rays @ normal)
        rays = rays[off <= 3.0 * np.median(off)]  # where another wire crosses, the edge is that one's
        normals.append(np.linalg.eigh(rays.T @ rays)[1][:, 0])
    between = float(np.linalg.norm(np.cross(normals[0], normals[1])))
    looks = float(np.arcsin(min(between, 1.0)) * camera.fx)
    width = looks + WIDTH_LOSS - MEETING * np.exp((MEETING_AT - looks) / MEETING_OVER)
    return float(width / camera.fx) if width >= MIN_WIDTH else 0.0
