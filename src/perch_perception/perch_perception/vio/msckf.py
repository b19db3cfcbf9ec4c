"""The multi-state constraint Kalman filter with landmarks in the state. Mourikis and Roumeliotis 2007; Li and Mourikis 2013.

Per frame: propagate with the IMU, clone the pose, update with landmarks that are still seen, make landmarks of tracks that
span the window, then update with tracks that have ended (their point eliminated).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from perch_perception.vio import ekf
from perch_perception.vio import state as at
from perch_perception.vio.bearing import POINT, Bearings, residuals
from perch_perception.vio.config import VioConfig
from perch_perception.vio.landmark_choice import Spread
from perch_perception.vio.propagation import propagate
from perch_perception.vio.sliding import TrackWalk
from perch_perception.vio.state import State
from perch_perception.vio.tracks import Track, Tracks
from perch_perception.vio.triangulation import triangulate

_GATE = 0.99  # chi2 of a track or landmark
_PARALLAX = 1.0  # of a triangulated point [deg]
_NEW_LANDMARKS = 5  # per frame, at most
_MAX_TRACKS = 12  # ended tracks used per frame
_MAX_REFUSALS = 3  # refused observations in a row after which a landmark is dropped
_CALIBRATION = np.arange(at.INERTIAL_SIZE, at.CORE_SIZE)


@dataclass
class FrameReport:
    """Result of a frame's update: numbers of observations used and refused.

    Attributes:
        nis, nis_dimension: normalised innovation squared of all that were used, with their joint covariance, and its dimension.
    """

    landmarks_used: int = 0
    tracks_used: int = 0
    refused: int = 0
    landmarks_new: int = 0
    nis: float = 0.0
    nis_dimension: int = 0

    @property
    def used(self) -> int:
        """Number of features that changed the state."""
        return self.landmarks_used + self.tracks_used + self.landmarks_new


class Msckf:
    """MSCKF that owns its state. The caller passes IMU steps and bearings; the filter depends on neither images nor ROS."""

    def __init__(self, config: VioConfig, state: State, focal_length: float) -> None:
        self.config, self.state = config, state
        self.tracks = Tracks()
        self.sigma = config.calibration.track / focal_length
        self.track_walk = TrackWalk(config, focal_length)
        self._gate = ekf.Gate(_GATE)
        self._used: set[int] = set()  # features whose information is in the state already

    def propagate(self, rows: np.ndarray, stamp: int) -> None:
        """Propagate the inertial state with IMU steps (m, 9) to a stamp [ns]."""
        if len(rows):
            propagate(self.state, rows, self.config.imu)
        self.state.stamp = stamp

    def add_frame(self, frame: int, ids: np.ndarray, bearings: Bearings) -> FrameReport:
        """Clone the pose at a frame and update with the features seen in it.

        Args:
            frame: number, increasing.
            ids: feature numbers, shape (n,).
            bearings: their bearings.
        """
        report, s = FrameReport(), self.state
        s.add_clone(frame)
        ended = {i: t for i, t in self.tracks.take_ended(ids).items() if i not in s.landmarks}
        self.tracks.observe(frame, ids, bearings)
        self._update_landmarks(report)
        if len(s.clones) >= self.config.filter.clones:
            spanning = self._spanning()
            self._add_landmarks(spanning, report)
            ended |= self._pop_unused_spanning(spanning)
        self._update_tracks(ended, report)
        s.drop_clones(list(range(len(s.clones) - self.config.filter.clones + 1)))
        if s.clones:
            self.tracks.forget_before(s.clones[0].frame)
        self._used &= self.tracks.by_id.keys()
        return report

    def apply(self, columns: np.ndarray, H: np.ndarray, r: np.ndarray, variance: float | np.ndarray) -> float:
        """Apply a Kalman update with a Jacobian over some columns to the whole state; return the normalised innovation squared.

        The lens is *considered*: its uncertainty counts in every gain and covariance, but it is not estimated (Schmidt).
        """
        lens = self.state.P[at.LENS, at.LENS]
        dx, self.state.P, nis = ekf.update(self.state.P, columns, H, r, variance)
        dx[at.LENS], self.state.P[at.LENS, at.LENS] = 0.0, lens
        self.state.inject(dx)
        return nis

    def _use(self, report: FrameReport, columns: np.ndarray, rows: list[np.ndarray], rests: list[np.ndarray]) -> None:
        """Update with the stacked rows of several observations, as one innovation."""
        H, r = ekf.compress(np.concatenate(rows), np.concatenate(rests))
        report.nis += self.apply(columns, H, r, self.sigma**2)
        report.nis_dimension += len(r)

    # -- landmarks in the state --------------------------------------------------------------------------------------

    def _update_landmarks(self, report: FrameReport) -> None:
        """Update with all landmarks seen in the newest frame; drop those that are not seen or are refused repeatedly."""
        s = self.state
        s.drop_landmarks({i for i in s.landmarks if i not in self.tracks.by_id})
        if not s.landmarks:
            return
        m, clone = len(s.landmarks), s.clones[-1]
        tracks = [self.tracks.by_id[i] for i in s.landmarks]
        seen = Bearings(np.array([t.b_C[-1] for t in tracks]), np.array([t.shape[-1] for t in tracks]))
        noise = np.array([t.noise[-1] for t in tracks])[:, None]
        now = self._residuals(clone.R_WB, clone.p_WB, np.array([k.X_W for k in s.landmarks.values()]), seen)
        k = s.clone_at(len(s.clones) - 1)
        columns = np.concatenate([_CALIBRATION, np.arange(k, k + 6), np.arange(s.landmark_start, s.size)])
        H = np.zeros((m, 2, len(columns)))
        H[:, :, : POINT.start] = now.J[:, :, : POINT.start]
        for i in range(m):
            k = POINT.start + 3 * i
            H[i, :, k : k + 3] = now.J[i, :, POINT]
        H, r = H / noise[:, :, None], now.r / noise
        self._add_track_walk(tracks, now.distance)
        P = s.P[np.ix_(columns, columns)]
        HP = (H.reshape(2 * m, -1) @ P).reshape(H.shape)
        S = np.einsum("kia,kja->kij", HP, H) + self.sigma**2 * np.eye(2)
        distance = np.einsum("ki,ki->k", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
        good = (distance < self._gate.limit(2)) & (now.cosine > 0.5)
        bad = set()
        for ok, (i, landmark) in zip(good, s.landmarks.items()):
            landmark.consecutive_refusals = 0 if ok else landmark.consecutive_refusals + 1
            if landmark.consecutive_refusals >= _MAX_REFUSALS:
                bad.add(i)
        report.landmarks_used, report.refused = int(good.sum()), report.refused + int((~good).sum())
        if good.any():
            self._use(report, columns, [H[good].reshape(-1, len(columns))], [r[good].ravel()])
        self._used |= bad
        s.drop_landmarks(bad)

    def _spanning(self) -> dict[int, Track]:
        """Return the tracks with parallax that span the whole window and are not in the state, most parallax first."""
        s, limits = self.state, self.config.filter
        oldest = s.clones[0].frame
        return self._with_parallax({
            i: t for i, t in self.tracks.by_id.items() if i not in s.landmarks and i not in self._used
            and t.frames[0] == oldest and len(t.frames) >= limits.clones - 1})

    def _pop_unused_spanning(self, spanning: dict[int, Track]) -> dict[int, Track]:
        """Remove and return spanning tracks that did not become landmarks, to be used as if ended; their features restart."""
        removed: dict[int, Track] = {}
        for i in spanning:
            if i not in self.state.landmarks and len(removed) < _MAX_TRACKS:
                removed[i] = self.tracks.by_id[i]
                self.tracks.by_id[i] = Track()
        return removed

    def _add_landmarks(self, spanning: dict[int, Track], report: FrameReport) -> None:
        """Make spanning tracks landmarks where the view has room for them."""
        s, limits = self.state, self.config.filter
        if limits.landmarks == 0:
            return
        spread = Spread({i: self.tracks.by_id[i].b_C[-1] for i in s.landmarks}, limits.landmarks)
        columns, rows, rests = self._window_columns(), [], []
        P = s.P[np.ix_(columns, columns)]
        candidates = {i: t for i, t in spanning.items() if spread.admits(t.b_C[-1])}
        for i, prepared in self._prepare_some(candidates, _NEW_LANDMARKS, report):
            if report.landmarks_new >= _NEW_LANDMARKS:
                break
            if prepared is None or not spread.admits(spanning[i].b_C[-1]):
                continue
            X, H_x, H_f, r = prepared
            R_f, H_1, r_1, H_0, r_0 = ekf.eliminate(H_x, H_f, r)
            if np.abs(np.diag(R_f)).min() < 1e-3:
                continue
            if ekf.squared_distance(H_0, P, r_0, self.sigma**2) > self._gate.limit(len(r_0)):
                report.refused += 1
                continue
            victim = spread.add(i, spanning[i].b_C[-1])
            if victim is not None:
                s.drop_landmarks({victim})
                self._used.add(victim)
            inverse = np.linalg.inv(R_f)
            cross = -inverse @ H_1 @ s.P[columns]
            own = inverse @ (H_1 @ P @ H_1.T + self.sigma**2 * np.eye(3)) @ inverse.T
            s.add_landmark(i, X, inverse @ r_1, cross, own)
            rows.append(H_0)
            rests.append(r_0)
            report.landmarks_new += 1
        if rows:
            self._use(report, columns, rows, rests)

    # -- tracks that have ended --------------------------------------------------------------------------------------

    def _update_tracks(self, ended: dict[int, Track], report: FrameReport) -> None:
        """Update with tracks that have just ended, longest first; their points are eliminated."""
        s = self.state
        useful = [t for i, t in ended.items() if i not in self._used and i not in s.landmarks and len(t.frames) >= 4]
        useful = sorted(useful, key=lambda t: -len(t.frames))[:_MAX_TRACKS]
        if not useful:
            return
        columns, rows, rests = self._window_columns(), [], []
        P = s.P[np.ix_(columns, columns)]
        for prepared in self._prepare(useful, report):
            if prepared is None:
                continue
            _, H_x, H_f, r = prepared
            _, _, _, H_0, r_0 = ekf.eliminate(H_x, H_f, r)
            if ekf.squared_distance(H_0, P, r_0, self.sigma**2) > self._gate.limit(len(r_0)):
                report.refused += 1
                continue
            report.tracks_used += 1
            rows.append(H_0)
            rests.append(r_0)
        if rows:
            self._use(report, columns, rows, rests)

    def _prepare_some(self, tracks: dict[int, Track], size: int, report: FrameReport) -> Iterator[tuple[int, tuple | None]]:
        """Yield feature numbers with their results of `_prepare`, computed on demand for `size` tracks at a time."""
        ids = list(tracks)
        for begin in range(0, len(ids), size):
            chunk = ids[begin : begin + size]
            yield from zip(chunk, self._prepare([tracks[i] for i in chunk], report))

    def _prepare(self, tracks: list[Track], report: FrameReport) -> list[tuple | None]:
        """Triangulate tracks and linearise their observations over calibration and window (`_window_columns`).

        Rays with parallax that do not intersect count as refused observations: the point moves, or the poses are wrong.

        Returns:
            For each track: X_W (3,), H_x (2m, k), H_f (2m, 3), r (2m,); None where it is not usable.
        """
        s = self.state
        place = {c.frame: j for j, c in enumerate(s.clones)}
        R, p = s.window()
        seen = [[k for k, f in enumerate(track.frames) if f in place] for track in tracks]
        chosen = [(n, track, ks) for n, (track, ks) in enumerate(zip(tracks, seen)) if len(ks) >= 4]
        out: list[tuple | None] = [None] * len(tracks)
        if not chosen:
            return out
        js = np.array([place[track.frames[k]] for _, track, ks in chosen for k in ks])
        bearings = Bearings(np.array([track.b_C[k] for _, track, ks in chosen for k in ks]),
                            np.array([track.shape[k] for _, track, ks in chosen for k in ks]))
        noise = np.array([track.noise[k] for _, track, ks in chosen for k in ks])
        centres = (p + R @ s.p_BC)[js]
        rays = np.einsum("nij,nj->ni", (R @ s.R_BC)[js], bearings.b_C)
        X, parts, begin, least = np.zeros((len(js), 3)), [], 0, np.radians(_PARALLAX)
        for number, _, ks in chosen:
            rows = slice(begin, begin + len(ks))
            begin = rows.stop
            X_W = triangulate(centres[rows], rays[rows], least, self.track_walk.spread(bearings.b_C[rows], noise[rows]))
            if X_W is None:
                report.refused += int(rays[rows.start] @ rays[rows.stop - 1] < np.cos(least))
            else:
                X[rows] = X_W
                parts.append((number, X_W, rows))
        if not parts:
            return out
        now = self._residuals(R[js], p[js], X, bearings)
        walk = self.track_walk.steps(bearings.b_C[:-1], bearings.b_C[1:], now.distance[:-1], now.distance[1:])
        n = len(_CALIBRATION)
        for number, X_W, rows in parts:
            m = rows.stop - rows.start
            A = np.zeros((m, 2, n + at.CLONE_SIZE * len(s.clones) + 4))
            A[:, :, :n] = now.J[rows, :, :n]
            A[:, :, n:-4].reshape(m, 2, -1, 6)[np.arange(m), :, js[rows]] = now.J[rows, :, n : POINT.start]
            A[:, :, -4:-1], A[:, :, -1] = now.J[rows, :, POINT], now.r[rows]
            white = self.track_walk.whitened(walk[rows.start : rows.stop - 1], now.distance[rows], A.reshape(m, -1), noise[rows]).reshape(2 * m, -1)
            out[number] = X_W, white[:, :-4], white[:, -4:-1], white[:, -1]
        return out

    def _window_columns(self) -> np.ndarray:
        """Indices of calibration and clones in the error."""
        return np.arange(at.INERTIAL_SIZE, self.state.landmark_start)

    def _with_parallax(self, tracks: dict[int, Track]) -> dict[int, Track]:
        """Return the tracks whose first and last rays in W differ enough for a triangulation, most parallax first."""
        if not tracks:
            return {}
        s = self.state
        R, place = s.window()[0] @ s.R_BC, {c.frame: j for j, c in enumerate(s.clones)}
        first, last = (np.einsum("nij,nj->ni", R[[place[t.frames[k]] for t in tracks.values()]],
                                 np.array([t.b_C[k] for t in tracks.values()])) for k in (0, -1))
        ends = (first * last).sum(axis=1)
        enough = np.cos(np.radians(_PARALLAX))
        order = np.argsort(ends, kind="stable")
        ids = list(tracks)
        return {ids[k]: tracks[ids[k]] for k in order if ends[k] < enough}

    def _add_track_walk(self, tracks: list[Track], distance: np.ndarray) -> None:
        """Add the walk of all landmarks since the last frame (`sliding`) to P; `distance`: from the camera [m], shape (n,)."""
        s = self.state
        if len(s.clones) < 2:
            return
        before, landmarks = s.clones[-2], list(s.landmarks.values())
        last = np.linalg.norm(np.array([k.X_W for k in landmarks]) - before.p_WB - before.R_WB @ s.p_BC, axis=1)
        b_last, b_now = (np.array([t.b_C[max(k, -len(t.b_C))] for t in tracks]) for k in (-2, -1))
        rows = s.landmark_start + np.arange(3 * len(tracks)).reshape(-1, 3)
        s.P[rows[:, :, None], rows[:, None, :]] += self.track_walk.of_points(b_last, b_now, last, distance, s.clones[-1].R_WB @ s.R_BC)

    def _residuals(self, R_WB: np.ndarray, p_WB: np.ndarray, X_W: np.ndarray, bearings: Bearings):
        s, n = self.state, len(X_W)
        return residuals(np.broadcast_to(R_WB, (n, 3, 3)), np.broadcast_to(p_WB, (n, 3)), X_W, s.R_BC, s.p_BC, bearings)
