"""Association of sightings with wires."""

from __future__ import annotations

from typing import Protocol
from collections.abc import Sequence

import numpy as np

from perch_core.covariance import largest_sigma
from perch_perception.line_mapping.detection import MIN_WIDTH, SIGMA
from perch_perception.line_mapping.observation import LineObservation
from perch_perception.line_mapping.triangulation import WireEstimate


WIDTH_RATIO = 1.4  # a wire looks as wide as it did, up to this factor: two that meet in the image look wider, a part of one less wide
MAPPED_GATE = 1.2  # of a sighting to a triangulated wire [deg]
TRACKED_GATE = 5.0  # to the last sighting of a wire that is not triangulated yet [deg]
AMBIGUITY_RATIO = 2.0  # the second-best wire must be so many times worse
MAX_EXTRAPOLATION = 1.5  # how far a wire may go on beyond what was seen [m]


class Track(Protocol):
    """Attributes of a tracked wire that the association requires."""

    estimate: WireEstimate | None
    last: LineObservation
    extent: tuple[float, float] | None


def score(track: Track, seen: LineObservation) -> float:
    """Return the misfit of a sighting to a wire in units of the gate; inf where they cannot match."""
    if not _width_matches(track, seen):
        return np.inf
    if track.estimate is not None:
        return _score_mapped(track.estimate, track.extent, seen)
    return _score_tracked(track.last, seen) / np.radians(TRACKED_GATE)


def _score_mapped(estimate: WireEstimate, extent: tuple[float, float] | None, seen: LineObservation) -> float:
    curve = estimate.curve
    centres = np.tile(seen.p_WC, (len(seen.rays_W), 1))
    against = curve.offsets(centres, seen.rays_W)
    if not np.all(against.ahead > 0):
        return np.inf
    s = against.s
    if extent is not None:
        low, high = extent
        if s.max() < low - MAX_EXTRAPOLATION or s.min() > high + MAX_EXTRAPOLATION:
            return np.inf
    middle = float(s[len(s) // 2])
    distance = float(np.linalg.norm(curve.at(middle) - seen.p_WC))
    unsure = largest_sigma(estimate.point_covariance(middle)) / max(distance, 0.1)
    return float(np.sqrt(np.mean(against.angles**2))) / (np.radians(MAPPED_GATE) + 2.0 * unsure)


def _score_tracked(last: LineObservation, seen: LineObservation) -> float:
    """Return the angle by which a sighting leaves the plane of the last one [rad]: parallax only, as rays are in W."""
    normal = last.normal
    offset = float(np.sqrt(np.mean((seen.rays_W @ normal) ** 2)))
    turned = float(np.arccos(np.clip(abs(seen.normal @ normal), 0.0, 1.0)))
    # along the arc: the pieces must overlap
    along = np.cross(normal, last.middle)
    spans = [sorted(float(np.arcsin(np.clip(r @ along, -1, 1))) for r in o.ends_W) for o in (last, seen)]
    gap = max(spans[0][0], spans[1][0]) - min(spans[0][1], spans[1][1])
    if gap > 0.05 or turned > 0.35:
        return np.inf
    return offset


def _width_matches(track: Track, seen: LineObservation) -> bool:
    """Whether a sighting is about as wide as the wire should appear, or was in its last image; unmeasurable widths match."""
    width = track.last.width if track.estimate is None else track.estimate.width_from(seen.p_WC)
    if np.isnan(width):  # nothing is known of its radius
        return True
    thin = _min_width(seen)
    return bool(1.0 / WIDTH_RATIO < max(seen.width, thin) / max(width, thin) < WIDTH_RATIO)


def _min_width(seen: LineObservation) -> float:
    """Return the width of the thinnest wire that can be measured [rad]."""
    return MIN_WIDTH / SIGMA * seen.sigma


def meets_another(tracks: Sequence[Track], owner: Track, seen: LineObservation) -> bool:
    """Whether another mapped wire may appear beside the observed one, so that the measured width is that of both.

    Args:
        tracks: all wires.
        owner: the observed wire.
        seen: the sighting.
    """
    own = owner.estimate
    if own is None or seen.width <= 0.0:
        return False
    centre = seen.p_WC[None]
    s = own.curve.nearest(centre, seen.middle[None])
    to = own.curve.at(s) - centre
    distance = float(np.linalg.norm(to))
    for track in tracks:
        other = track.estimate
        if track is owner or other is None or track.extent is None:
            continue
        against = other.curve.offsets(centre, to / distance)
        if against.ahead[0] <= 0.0 or not track.extent[0] - MAX_EXTRAPOLATION < against.s[0] < track.extent[1] + MAX_EXTRAPOLATION:
            continue
        apart, half, its = abs(float(against.angles[0])), 0.5 * own.width_from(seen.p_WC), 0.5 * other.width_from(seen.p_WC)
        unsure = np.hypot(largest_sigma(own.point_covariance(float(s[0]))) / distance,
                          largest_sigma(other.point_covariance(float(against.s[0]))) / float(against.ahead[0]))
        if half - its - unsure < apart < half + its + unsure + _min_width(seen):  # neither hidden behind it nor apart from it
            return True
    return False


def associate(tracks: Sequence[Track], seen: Sequence[LineObservation]) -> list[int | None]:
    """Return for each sighting the index of its wire, -1 for a new wire, or None where it could be one of several.

    A triangulated wire may have several sightings in one image; a wire that is not triangulated yet has at most one.
    """
    scores = np.array([[score(track, one) for track in tracks] for one in seen]).reshape(len(seen), len(tracks))
    answer: list[int | None] = [-1] * len(seen)
    taken: set[int] = set()
    order = sorted((scores[i, j], i, j) for i in range(len(seen)) for j in range(len(tracks)) if scores[i, j] <= 1.0)
    done: set[int] = set()
    for value, i, j in order:
        if i in done or j in taken:
            continue
        done.add(i)
        rivals = [scores[i, k] for k in range(len(tracks)) if k != j]
        if rivals and min(rivals) < min(1.0, AMBIGUITY_RATIO * max(value, 0.1)):
            answer[i] = None
            continue
        answer[i] = j
        if tracks[j].estimate is None:
            taken.add(j)
    return answer
