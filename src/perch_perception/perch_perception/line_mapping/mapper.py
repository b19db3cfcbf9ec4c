"""Map of wires: sightings with the poses of their exposures in, segments with covariance out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perch_core import config, so3
from perch_core.covariance import largest_sigma
from perch_core.lines import Segment
from perch_core.values import MappedPowerline, PowerlineMap, limits, nanoseconds
from perch_perception.line_mapping.association import associate, meets_another
from perch_perception.line_mapping.curve import WireCurve
from perch_perception.line_mapping.observation import LineObservation
from perch_perception.line_mapping.triangulation import (
    TriangulationConfig, Undetermined, WireEstimate, triangulate)
from perch_perception.pose_buffer import BodyState

BASELINE = 0.03  # motion between the sightings kept [m]
TURN = 3.0  # or rotation between them [deg]
MAX_OBSERVATIONS = 40  # sightings kept per wire
FORGET_AFTER = 2.0  # a wire that was never triangulated, or is not published yet, and is not seen is dropped [s]
STALE_AFTER, SUPERSEDED = 0.4, 0.3  # a wire not seen for so long gives way to one that is seen so close to it [s, m]
MAX_RANGE = 8.0  # ends of wires further away are not used [m]
STRAIGHTNESS = 0.02  # a sagging wire is cut into chords that stay within this [m]
PIECE_IDS = 1_000_000  # ids of the pieces of wire k: k, k + 1,000,000, ...; so many wires have an id before one is used again
ATTACHED_COUNT = 3    # surplus of images that show a line attached to the surface beside it: it is no wire
MIN_OBSERVATIONS = 4  # fewer sightings are not published, nor called degenerate
MAX_LINES = limits.LIMITS[PowerlineMap]["lines"].count_max  # that receivers accept
FORGET_BEYOND = 50.0  # a triangulated wire out of view that is further away from the vehicle is dropped [m]


@dataclass(frozen=True)
class MapperConfig:
    """Settings of the mapper."""

    max_sigma: float = config.quantity(0.15, unit="m", above=0.0, high=5.0, doc="wires known worse than this are not published")
    triangulation: TriangulationConfig = config.part(TriangulationConfig)


@dataclass(eq=False)
class _Track:
    id: int
    observations: list[LineObservation]
    last: LineObservation
    count: int = 1
    estimate: WireEstimate | None = None
    extent: tuple[float, float] | None = None
    refusal: str = "seen from one place only: move across the wire"
    attached: int = 0  # images that show it to be attached to what is beside it, less those that show it apart


class LineMapper:
    """Tracks, triangulates and stores wires. The state is the list of wires.

    Wires are stored in a frame without the odometry's corrections (`BodyState.corrected`): these move neither the vehicle nor the
    wire relative to the vehicle. The map is published in the odometry's present W.
    """

    def __init__(self, settings: MapperConfig | None = None) -> None:
        self.settings = settings or MapperConfig()
        self._tracks: list[_Track] = []
        self._next_id = 0
        self._body: BodyState | None = None  # of the last image; its position is without the corrections

    def update(self, time: float, body: BodyState, seen: Sequence[LineObservation],
               attached: Callable[[LineObservation, WireCurve], bool | None] | None = None) -> PowerlineMap:
        """Update the map with the sightings of one image.

        Args:
            time: of the exposure [s].
            body: state of the body at that time; the covariance of its attitude is the odometry's share of the map's.
            seen: the sightings, placed with this state.
            attached: returns whether a sighting of a wire (both without the odometry's corrections) lies on the surface beside
                it; None: undecided.
        """
        self._body = replace(body, p_WB=body.p_WB - body.corrected)
        seen = [replace(one, p_WC=one.p_WC - body.corrected) for one in seen]
        changed: set[int] = set()
        owners = associate(self._tracks, seen)
        for one, owner in zip(seen, owners):
            if owner is None:
                continue
            if owner < 0:
                self._tracks.append(_Track(self._free_id(), [one], one))
            elif self._extend(self._tracks[owner], one):
                changed.add(owner)
        for index in sorted(changed):
            self._triangulate(self._tracks[index])
        if attached is not None:
            self._count_attached(seen, owners, attached)
        self._merge({self._tracks[index] for index in changed})
        self._supersede(time)
        self._tracks = [t for t in self._tracks if time - t.last.time <= FORGET_AFTER
                        or t.estimate is not None and t.count >= MIN_OBSERVATIONS and t.attached < ATTACHED_COUNT
                        and _distance(t, self._body.p_WB) < FORGET_BEYOND]
        return self.map(time)

    def _free_id(self) -> int:
        """Return the id of a new wire, below `PIECE_IDS`: the next one that no wire of the map has."""
        used, free = {track.id for track in self._tracks}, self._next_id
        while free in used:
            free = (free + 1) % PIECE_IDS
        self._next_id = (free + 1) % PIECE_IDS
        return free

    def _count_attached(self, seen: Sequence[LineObservation], owners: Sequence[int | None],
               attached: Callable[[LineObservation, WireCurve], bool | None]) -> None:
        """Count for each observed wire the images that show it attached to the surface beside it, less those that do not."""
        for one, owner in zip(seen, owners):
            if owner is None or owner < 0:
                continue
            track = self._tracks[owner]
            if track.estimate is not None:
                verdict = attached(one, track.estimate.curve)
                track.attached += 0 if verdict is None else 1 if verdict else -1

    def map(self, time: float) -> PowerlineMap:
        """Return the map at the time of the last image [s], its lines sorted by id."""
        lines: list[MappedPowerline] = []
        missing: list[str] = []
        for track in self._tracks:
            if track.count < MIN_OBSERVATIONS or track.attached >= ATTACHED_COUNT:
                continue
            segments, reason = self._segments(track)
            lines += segments
            if reason is not None and time - track.last.time <= FORGET_AFTER:  # what is out of view may never be known better
                missing.append(f"line {track.id}: {reason}")
        checked = [(line, limits.problem(line)) for line in lines]
        lines = [line for line, problem in checked if not problem]
        refused = [f"line {line.id}: {problem}" for line, problem in checked if problem]
        if len(lines) > MAX_LINES and self._body is not None:
            p_WB = self._body.p_WB + self._body.corrected
            lines = sorted(lines, key=lambda line: float(line.segment.distance(p_WB)))[:MAX_LINES]
            refused.append(f"only the nearest {MAX_LINES} lines are published")
        return PowerlineMap(nanoseconds(time), tuple(sorted(lines, key=lambda line: line.id)), bool(missing), "; ".join(missing + refused))

    def _extend(self, track: _Track, one: LineObservation) -> bool:
        """Add a sighting; return False where it is from the same place as the last and is not kept."""
        before = track.observations[-1]
        track.last = one
        track.count += 1
        moved = np.linalg.norm(one.p_WC - before.p_WC) >= BASELINE
        elsewhere = float(one.middle @ before.middle) < np.cos(np.radians(TURN))
        if not moved and not elsewhere:
            return False
        track.observations.append(replace(one, width=0.0) if meets_another(self._tracks, track, one) else one)
        if len(track.observations) > MAX_OBSERVATIONS:
            track.observations = _drop_redundant(track.observations)
        return True

    def _triangulate(self, track: _Track) -> None:
        try:
            track.estimate = triangulate(track.observations, self.settings.triangulation, track.estimate)
        except Undetermined as refusal:
            if track.estimate is None:
                track.refusal = str(refusal)
            return
        track.extent = self._extent(track.observations, track.estimate)

    def _extent(self, observations: Sequence[LineObservation], estimate: WireEstimate) -> tuple[float, float] | None:
        """Return the range of s that was seen at least twice; None where there is none."""
        curve = estimate.curve
        used = [one for one, good in zip(observations, estimate.used) if good]
        centres = np.repeat([one.p_WC for one in used], 2, axis=0)
        rays = np.concatenate([one.ends_W for one in used])
        against = curve.offsets(centres, rays)
        tangent = curve.tangent(against.s)
        glancing = np.abs(np.sum(rays * tangent, axis=1)) / np.linalg.norm(tangent, axis=1)
        good = (glancing < np.cos(np.radians(8.0))) & (np.abs(against.ahead) < MAX_RANGE)
        both = good.reshape(-1, 2).all(axis=1)
        if both.sum() < 2:
            return None
        ends = np.sort(against.s.reshape(-1, 2)[both], axis=1)
        low, high = float(np.sort(ends[:, 0])[1]), float(np.sort(ends[:, 1])[-2])
        return (low, high) if high - low > 0.1 else None

    def _merge(self, changed: set[_Track]) -> None:
        """Merge wires that turned out to be the same, now that some have changed; the older one keeps its id."""
        kept: list[_Track] = []
        kept_changed: list[_Track] = []
        for track in self._tracks:
            twin = next((other for other in (kept if track in changed else kept_changed) if _same_wire(other, track)), None)
            if twin is None:
                kept.append(track)
                kept_changed += [track] if track in changed else []
                continue
            merged = sorted(twin.observations + track.observations, key=lambda one: one.time)
            while len(merged) > MAX_OBSERVATIONS:
                merged = _drop_redundant(merged)
            twin.observations, twin.count, twin.attached = merged, twin.count + track.count, twin.attached + track.attached
            twin.last = max(twin.last, track.last, key=lambda one: one.time)
            self._triangulate(twin)
            kept_changed.append(twin)
        self._tracks = kept

    def _supersede(self, time: float) -> None:
        """Drop stale wires that a fresh wire beside them replaces, for example after a correction of the odometry.

        A wire that was seen before the stale one went out of view is a different wire, and does not replace it.
        """
        fresh = [t for t in self._tracks if t.estimate is not None and t.extent is not None and t.count >= MIN_OBSERVATIONS
                 and time - t.last.time <= STALE_AFTER]
        self._tracks = [t for t in self._tracks if time - t.last.time <= STALE_AFTER
                        or not any(other.observations[0].time > t.last.time and _is_adjacent(t, other, SUPERSEDED) for other in fresh)]

    def _segments(self, track: _Track) -> tuple[list[MappedPowerline], str | None]:
        """Return the wire as chords that stay within `STRAIGHTNESS`, or none and the reason."""
        estimate = track.estimate
        if estimate is None:
            return [], track.refusal
        if track.extent is None:
            return [], "its ends were not seen yet"
        assert self._body is not None  # it was seen from somewhere
        low, high = track.extent
        length = high - low
        sag = abs(estimate.curve.curvature) * length**2 / 8.0
        # a chord is as far from its parabola as that sags below it; half of that once it is moved by half the sag
        pieces = max(1, int(np.ceil(np.sqrt(sag / (2.0 * STRAIGHTNESS)))))
        radius = float(estimate.radius) if np.isfinite(estimate.radius) else self.settings.triangulation.radius
        lines = []
        for k in range(pieces):
            a, b = low + length * k / pieces, low + length * (k + 1) / pieces
            covariance = self._covariance(estimate, 0.5 * (a + b))
            sigma = largest_sigma(covariance)
            if sigma > self.settings.max_sigma:
                return [], f"position uncertainty of {sigma:.2f} m is too large"
            start, end = _chord(estimate.curve, a, b, radius, self._body.corrected).ends
            lines.append(MappedPowerline(track.id + PIECE_IDS * k, tuple(start.tolist()), tuple(end.tolist()), radius, covariance,
                                         self._direction_sigma(estimate), track.count))
        return lines, None

    def _covariance(self, estimate: WireEstimate, s: float) -> np.ndarray:
        """Return the covariance of the point at s relative to the vehicle, from sightings and attitude, shape (3, 3) [m^2].

        The sightings' part includes the camera's mount, which the fit estimates, and the odometry's drift between them. The drift
        since the last sighting of a wire out of view is excluded: its position is that relative to the vehicle when it was last seen.
        """
        assert self._body is not None  # it was seen from somewhere
        lever = so3.hat(estimate.curve.at(s) - self._body.p_WB)
        return estimate.point_covariance(s) + lever @ self._body.covariance[3:, 3:] @ lever.T

    def _direction_sigma(self, estimate: WireEstimate) -> float:
        assert self._body is not None
        attitude = np.linalg.eigvalsh(self._body.covariance[3:, 3:])[-1]
        return float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[2:4, 2:4])[-1] + attitude))


def _distance(track: _Track, p_WB: np.ndarray) -> float:
    """Distance of the vehicle from the seen part of a triangulated wire [m]."""
    assert track.estimate is not None
    curve, (low, high) = track.estimate.curve, track.extent or (0.0, 0.0)
    return float(np.linalg.norm(curve.at(np.clip((p_WB - curve.point) @ curve.direction, low, high)) - p_WB))


def _chord(curve: WireCurve, a: float, b: float, radius: float, offset: np.ndarray) -> Segment:
    """Return the segment nearest to the wire between a and b: its chord, moved by half of the sag and `offset` (3,) [m]."""
    lift = -curve.curvature * (b - a) ** 2 / 16.0
    shift = lift * curve.axes[:, 1] + offset
    return Segment.between(curve.at(a) + shift, curve.at(b) + shift, radius)


def _drop_redundant(observations: list[LineObservation]) -> list[LineObservation]:
    """Return the sightings without the one whose neighbours are nearest to each other, which keeps the baseline."""
    centres = np.array([o.p_WC for o in observations])
    gaps = np.linalg.norm(centres[2:] - centres[:-2], axis=1)
    out = int(np.argmin(gaps)) + 1
    return observations[:out] + observations[out + 1:]


def _same_wire(a: _Track, b: _Track) -> bool:
    """Whether two triangulated wires coincide: within 6 cm where the second was seen, and 3 deg."""
    return _is_adjacent(a, b, 0.06)


def _is_adjacent(a: _Track, b: _Track, distance: float) -> bool:
    """Whether two triangulated wires run together: within a distance [m] where the second was seen, and 3 deg."""
    if a.estimate is None or b.estimate is None or b.extent is None:
        return False
    if abs(a.estimate.curve.direction @ b.estimate.curve.direction) < np.cos(np.radians(3.0)):
        return False
    points = b.estimate.curve.at(np.linspace(*b.extent, 3))
    along = a.estimate.curve.direction
    s = (points - a.estimate.curve.point) @ along
    return bool(np.all(np.linalg.norm(points - a.estimate.curve.at(s), axis=1) < distance))
