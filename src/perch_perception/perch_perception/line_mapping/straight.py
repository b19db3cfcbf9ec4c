"""Selection of wires among ridge points: long straight arcs, beyond chance, with the same background on both sides.

A straight wire lies on a plane through the optical centre, under any lens: every ridge point votes for the great circles on which
it may lie. Whether an arc has more points than chance is estimated from the image itself: ridges of the same direction beside the
arc show how common they are. Kerbs, roofs and the edges of fields are ridges as well, but they end within the image, and most
have different backgrounds on their two sides. A wire crosses the image from its border, or is parallel to one that does.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_core.probability import binomial_tail
from perch_perception.line_mapping.ridges import Ridges

TURNS = np.radians(np.arange(-9.0, 9.1, 1.5))  # about the ray, by which a ridge's direction may be wrong
CELL_ANGLE, CELL_OFFSET = np.radians(1.5), 3.0  # of the vote [rad], [px]
ASKEW = np.cos(np.radians(12.0))   # a ridge point of an arc goes along it within this
REACH = 4.0                        # points so near to the voted arc are fitted [px]
CANDIDATES = 24                    # arcs looked at for each sign
FEWEST = 10                        # points of an arc
STRIDE = 4.0                       # an arc is looked at in pieces of this length [px]
BESIDE = (7.0, 16.0)               # strips on both sides that say how common ridges are [px]
SEEN = 0.5                         # share of the pieces of an arc that show a ridge, at least, all along it
TESTS = 6.0                        # log10 of the arcs that an image could hold
CHANCE = -10.0                     # log10 of the arcs as good that chance would put into an image, at most
CROSSES, BESIDE_ONE = 0.6, 0.4     # share of its great circle in the image that a wire covers: alone, beside one that covers that much
SHORT = 0.05                       # share of its great circle that a wire alone leaves free at one end: it comes from outside the image
PARALLEL = np.radians(10.0)        # directions in the image of wires of one line
WHOLE = 0.4                        # salience of a thick wire as a whole, as a share of its rims', at least
LOBE = 8.0                         # the rims of a line are ridges of the other sign, so far from it at its level [px]


@dataclass(frozen=True, eq=False)
class Arc:
    """Ridge points along a great circle.

    Attributes:
        points: their indices, in order along it, shape (n,).
        scatter: of the points across the arc, 1 sigma [px].
        normal: of the circle's plane in C, shape (3,).
        bright: whether it is brighter than both sides.
        chance: log10 of the number of equally good arcs expected by chance.
        share: share of the circle's visible part that the arc covers.
        short: gap between the arc and the nearer border of the image, as a share of the circle's visible part.
        salience: curvature across it times its number of points.
        level: median pyramid level of its points.
    """

    points: np.ndarray
    scatter: float
    normal: np.ndarray
    bright: bool
    chance: float
    share: float
    short: float
    salience: float
    level: float


def wires(found: Ridges, camera: Camera, tolerance: float, least: float) -> list[Arc]:
    """Return the arcs that are classified as wires.

    Args:
        found: ridge points of an image.
        camera: its lens.
        tolerance: greatest distance of a point from its arc [px].
        least: shorter arcs are left out [px].
    """
    rays = camera.unproject(found.pixels)
    arcs = sorted((arc for arc in _arcs(found, rays, camera, tolerance, least) if arc.chance < CHANCE), key=lambda arc: -arc.salience)
    kept: list[Arc] = []
    while arcs:
        lines = [arc for arc in arcs if arc is arcs[0] or _same_line(arc, arcs[0], rays, camera.fx)]
        whole = [arc for arc in lines if arc.bright == arcs[0].bright and arc.salience > WHOLE * arcs[0].salience]
        kept.append(max(whole, key=lambda arc: arc.level))  # the rims of a thick wire are lines as well
        arcs = [arc for arc in arcs if arc not in lines and not _same_line(arc, kept[-1], rays, camera.fx)]
    across = [arc for arc in kept if arc.share > CROSSES and arc.short < SHORT]
    return [one for one in kept if one in across or one.share > BESIDE_ONE and any(_parallel(one, other) for other in across)]


def _same_line(one: Arc, other: Arc, rays: np.ndarray, focal: float) -> bool:
    """Whether an arc duplicates another one, or is a rim of it."""
    return bool(np.mean(np.abs(rays[one.points] @ other.normal) * focal < LOBE * 2.0**other.level) > 0.6)


def _parallel(one: Arc, other: Arc) -> bool:
    turn = np.arctan2(one.normal[1], one.normal[0]) - np.arctan2(other.normal[1], other.normal[0])
    return abs((turn + 0.5 * np.pi) % np.pi - 0.5 * np.pi) < PARALLEL


def _arcs(found: Ridges, rays: np.ndarray, camera: Camera, tolerance: float, least: float) -> list[Arc]:
    """Return the arcs of both signs with the same background on both sides."""
    ahead = camera.unproject(found.pixels + 2.0 * found.tangents)
    normals = np.cross(rays, ahead)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen, out = np.isfinite(normals).all(axis=1), []
    for bright in (True, False):
        index = np.flatnonzero(seen & ((found.bend < 0.0) == bright))
        if not len(index):
            continue
        votes = _Votes(rays[index], normals[index], camera.fx)
        some, straight, left = Ridges(*(getattr(found, f.name)[index] for f in fields(found))), normals[index], np.ones(len(index), bool)
        for _ in range(CANDIDATES):
            normal = votes.most(least / STRIDE)
            if normal is None:
                break
            arc, used = _along(some, rays[index], straight, left, normal, camera, tolerance, least)
            if arc is not None:
                out.append(replace(arc, points=index[arc.points]))
            if not used.any():
                break
            left &= ~used
            votes.take(used)
    return out


class _Votes:
    """Number of points that may lie on the plane of each cell: its direction in the image, its angle from the optical axis."""

    def __init__(self, rays: np.ndarray, normals: np.ndarray, focal: float) -> None:
        planes = np.cos(TURNS)[:, None, None] * normals + np.sin(TURNS)[:, None, None] * np.cross(rays, normals)
        planes *= np.where(planes[..., 1:2] < 0.0, -1.0, 1.0)
        self._offset = CELL_OFFSET / focal
        angle = (np.arctan2(planes[..., 1], planes[..., 0]) / CELL_ANGLE).astype(int)  # of [0, pi]
        offset = ((np.arcsin(np.clip(planes[..., 2], -1.0, 1.0)) + 0.5 * np.pi) / self._offset).astype(int)
        self._shape = int(np.pi / CELL_ANGLE) + 2, int(np.pi / self._offset) + 2
        self._cells = angle * self._shape[1] + offset
        self._votes = np.zeros(self._shape, np.float32)
        self.take(np.ones(len(rays), bool), -1.0)

    def take(self, points: np.ndarray, count: float = 1.0) -> None:
        """Remove the votes of points (n,), `count` per vote."""
        cells = self._cells[:, points].ravel()
        self._votes -= count * np.bincount(cells, minlength=self._votes.size).reshape(self._shape).astype(np.float32)

    def most(self, least: float) -> np.ndarray | None:
        """Return the normal (3,) of the plane with most votes; None where it has fewer than `least` with its neighbours."""
        sums = cv2.blur(self._votes, (3, 3), borderType=cv2.BORDER_CONSTANT)
        row, column = np.unravel_index(np.argmax(sums), self._shape)
        if 9.0 * sums[row, column] < least:
            return None
        angle, z = (row + 0.5) * CELL_ANGLE, np.sin((column + 0.5) * self._offset - 0.5 * np.pi)
        across = np.sqrt(1.0 - z * z)
        return np.array([across * np.cos(angle), across * np.sin(angle), z])


def _along(found, rays, normals, left, normal, camera, tolerance, least) -> tuple[Arc | None, np.ndarray]:
    """Return the arc near a plane among the points `left`, or None, and the points that are used up by it."""
    focal, used = camera.fx, np.zeros(len(left), bool)
    across, turned = np.arcsin(np.clip(rays @ normal, -1.0, 1.0)) * focal, normals @ normal
    near = np.flatnonzero(left & (np.abs(turned) > ASKEW) & (np.abs(across) < BESIDE[1] + 2.0 * REACH))
    across, turned, rays = across[near], turned[near], rays[near]
    used[near[np.abs(across) < REACH]] = True
    if used.sum() < FEWEST:
        return None, used
    forward = rays[np.abs(across) < REACH].mean(axis=0)
    forward -= (forward @ normal) * normal
    forward /= np.linalg.norm(forward)
    side = np.cross(normal, forward)
    along = np.arctan2(rays @ side, rays @ forward)
    powers, off = np.stack([np.ones_like(along), along, along * along]), across
    for reach in (2.0 * REACH, REACH, tolerance):
        member = np.abs(off) < reach
        if member.sum() < FEWEST:
            return None, used
        weighed = powers[:, member] / (1.0 + off[member] ** 2)
        off = across - np.linalg.solve(weighed @ powers[:, member].T + 1e-9 * np.eye(3), weighed @ across[member]) @ powers
    member = np.abs(off) < tolerance
    if member.sum() < FEWEST:
        return None, used
    first, pieces = along[member].min(), int(np.ptp(along[member]) * focal / STRIDE) + 1
    piece = np.floor((along - first) * focal / STRIDE).astype(int)
    shown = np.zeros(pieces, bool)
    shown[np.clip(piece[member], 0, pieces - 1)] = True
    begin, end = _densest(shown)
    count = end - begin
    within = (piece >= begin) & (piece < end)
    used[near[within & (np.abs(off) < REACH)]] = True
    points = np.flatnonzero(member & within)
    if count * STRIDE < least or len(points) < FEWEST:
        return None, used
    at = near[points]
    if abs(np.median(found.step[at] * np.sign(turned[points]))) > abs(np.median(found.height[at])):
        return None, used
    beside = within & (np.abs(off) > BESIDE[0]) & (np.abs(off) < BESIDE[1])
    cells = len(np.unique(piece[beside] + 2 * pieces * np.floor(off[beside] / (2.0 * tolerance)).astype(int)))
    usual = cells / (count * (BESIDE[1] - BESIDE[0]) / tolerance)
    with np.errstate(divide="ignore"):  # so good that chance never does it
        chance = TESTS + float(np.log10(binomial_tail(int(shown[begin:end].sum()), count, min(max(usual, 0.02), 1.0))))
    points = points[np.argsort(along[points], kind="stable")]
    low, high = along[points[0]], along[points[-1]]
    first, last = _visible(camera, forward, side, 0.5 * (low + high))
    share, short = (high - low) / (last - first), min(low - first, last - high) / (last - first)
    return Arc(near[points], float(np.std(off[points])), normal, bool(found.bend[at[0]] < 0.0), chance, float(share), float(short),
               float(np.median(np.abs(found.bend[at])) * count), float(np.median(found.level[at]))), used


def _visible(camera: Camera, forward: np.ndarray, side: np.ndarray, middle: float) -> tuple[float, float]:
    """Return the angles along the great circle between which it is visible, around the angle `middle` [rad]."""
    angles = middle + np.linspace(-np.pi, np.pi, 721)
    pixels, valid = camera.project(np.cos(angles)[:, None] * forward + np.sin(angles)[:, None] * side)
    hidden = ~(valid & camera.contains(pixels))
    hidden[0] = hidden[-1] = True
    ends = np.flatnonzero(hidden)
    return float(angles[ends[ends < 360].max()]), float(angles[ends[ends > 360].min()])


def _densest(shown: np.ndarray) -> tuple[int, int]:
    """Return the stretch of pieces in which the number of ridges most exceeds the share `SEEN` (Kadane's algorithm)."""
    total = np.concatenate([[0.0], np.cumsum(np.where(shown, 1.0 - SEEN, -SEEN))])
    end = int(np.argmax(total - np.minimum.accumulate(total)))
    return int(np.argmin(total[:end + 1])), end
