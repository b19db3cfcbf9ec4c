"""Start in motion: gyro bias, gravity, velocity and scale from the IMU and the tracks of half a second or more, in closed form.

The gyro's bias is solved for first, as a wrong rotation would distort everything else (`gyro_bias`). Then, in the body frame B0
of the first frame, with preintegrated dR, dp and p_k = v0 T + g0 T^2/2 + dp_k + (d dp_k / d b_a) b_a, every observation requires
that the point lies on its ray:  (I - d d^T)(X_j - p_k - dR_k p_BC) = 0,  d = dR_k R_BC b.  This is linear in v0, g0, b_a and all
X_j; the points are eliminated, b_a has its prior, and the remaining 9 x 9 system is solved with |g0| = g. (Dong-Si and Mourikis
2012.)

The closed form takes many quantities as exact. From each of its minima `start_refinement` continues with all unknowns; the most
likely result is the start, unless another is about as likely, or the scale is poorly known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.covariance import largest_sigma
from perch_core.vehicle import GRAVITY

from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.vio import start
from perch_perception.vio import state as at
from perch_perception.vio.bearing import Bearings
from perch_perception.vio.config import VioConfig
from perch_perception.vio.gyro_bias import RayPair, solve_gyro_bias
from perch_perception.vio.preintegration import Preintegration, preintegrate
from perch_perception.vio.start import KnownPose
from perch_perception.vio.start_refinement import PointObservations, Refined, refine
from perch_perception.vio.state import State
from perch_perception.vio.tracks import Tracks
from perch_perception.vio.triangulation import triangulate

DURATION = 0.5       # of the frames after which a start is tried first [s]
_TRACK_NOISE = 1.0  # 1 sigma of a track about its point over the frames of a start [px]
_MIN_FEATURES = 12
_LEAST_FRAMES = 6
_MOST_FRAMES = 16      # of the longest stretch; more cost time and tell little
_ITERATIONS = 10
_LONGEST = 3.0         # stretch that is kept, in that after which a start is tried
_PAUSE = 0.2           # of that, from a trial that failed to the next: it takes as long as ten frames, and one more tells little
_GYRO_SIGMA = 0.02     # bias known at least so well before anything else is solved [rad/s]
_PARALLAX_DEG = 0.3
_MOST_POINTS = 40
_MISFIT, _KEPT = 4.0, 0.6  # most chi^2 for each degree of freedom, least share of the points that fit
_SCALE = 0.3   # 1 sigma of the logarithm of the scale: known worse, it is too far from Gaussian for a filter
_RIVAL = 10.8  # another minimum that is no less likely than that (chi^2 of one, 99.9 %) is an ambiguity
_TILT, _SPEED = 0.2, 0.5  # 1 sigma with which a filter may start [rad, m/s]


@dataclass(frozen=True)
class MotionSolution:
    """Velocity and gravity in B0 and the accelerometer's bias (3,), covariance of all stacked (9, 9), and the RMS residual [rad].

    The covariance assumes tracks with twice the given noise.
    """

    v: np.ndarray
    g: np.ndarray
    accel_bias: np.ndarray
    covariance: np.ndarray
    residual: float


def solve_motion(T: np.ndarray, dp: np.ndarray, dv: np.ndarray, by_bias: np.ndarray, centres: np.ndarray, rays: np.ndarray,
                 seen: np.ndarray, sigma: float, bias_sigma: float) -> list[MotionSolution]:
    """Solve for velocity, gravity and accelerometer bias from rays: local maxima of the likelihood.

    The closed form weights far points more than near ones, and so prefers a scale that is too small. It is therefore only the
    initial guess of Gauss-Newton on the bearings. Where it collapses, gravity along the mean force, with larger velocities, is a
    better guess.

    Args:
        T: time since the first frame [s], shape (n,).
        dp: preintegrated positions in B0 [m], shape (n, 3).
        dv: preintegrated velocity at the last of the frames in B0 [m/s], shape (3,).
        by_bias: derivatives of dp with respect to the accelerometer's bias, shape (n, 3, 3).
        centres: dR_k p_BC, camera centres relative to the body in B0 [m], shape (n, 3).
        rays: unit rays of m features in B0, shape (m, n, 3).
        seen: whether a feature is seen in a frame, shape (m, n).
        sigma: 1 sigma of a ray [rad].
        bias_sigma: prior 1 sigma of the accelerometer's bias [m/s^2].

    Returns:
        Solutions, the most likely first; none where the motion does not determine velocity and gravity.
    """
    G = np.concatenate([T[:, None, None] * np.eye(3), 0.5 * T[:, None, None] ** 2 * np.eye(3), by_bias], axis=2)
    begins: list[tuple[np.ndarray | None, float]] = [(None, 1.0)]
    if (gained := float(np.linalg.norm(dv))) > 1e-6:  # zero in free fall, or from an IMU that reads zero
        begins += [(dv * (-GRAVITY / gained), scale) for scale in (1.0, 3.0, 10.0)]
    found = [_refined(G, dp + centres, rays, seen, sigma, bias_sigma, *begin) for begin in begins]
    distinct: list[MotionSolution] = []
    for _, end in sorted((end for end in found if end is not None), key=lambda end: end[0]):
        if not any(np.linalg.norm(end.g - other.g) < 0.5 and np.linalg.norm(end.v - other.v) < 0.2 * np.linalg.norm(other.v) for other in distinct):
            distinct.append(end)
    return distinct


def _refined(G: np.ndarray, e: np.ndarray, rays: np.ndarray, seen: np.ndarray, sigma: float, bias_sigma: float,
             gravity: np.ndarray | None, scale: float) -> tuple[float, MotionSolution] | None:
    """Run Gauss-Newton from the closed form; return its cost and solution, or None where it fails.

    The closed form uses a given gravity (3,) and multiplies its velocity by `scale`; without one it solves for gravity as well.
    Camera k is at G_k y + e_k, shapes (n, 3, 9), (n, 3), with y = (v, g, b_a).
    """
    u, distance = rays, np.ones(seen.shape)
    prior = np.diag(np.repeat([0.0, 0.0, (sigma / bias_sigma) ** 2], 3))
    y, used = np.zeros(9), seen
    for iteration in range(_ITERATIONS):
        M = (np.eye(3) - u[..., :, None] * u[..., None, :]) * (used / distance**2)[..., None, None]
        A = M.sum(axis=1)
        eigenvalues = np.linalg.eigvalsh(A)
        determined = eigenvalues[:, 0] > 1e-6 * eigenvalues.sum(axis=1)
        if determined.sum() < _MIN_FEATURES:
            return None  # too little parallax
        u, distance, rays, seen, used, M, A = (x[determined] for x in (u, distance, rays, seen, used, M, A))
        target = e + distance[..., None] * rays  # the point is X = target + G y, but for what M does not see
        MG, Mt = np.einsum("fkij,kjl->fkil", M, G), np.einsum("fkij,fkj->fki", M, target)
        inverse, SG, St = np.linalg.inv(A), MG.sum(axis=1), Mt.sum(axis=1)
        N = np.einsum("kji,fkjl->il", G, MG) - np.einsum("fji,fjk,fkl->il", SG, inverse, SG)
        b = np.einsum("fji,fjk,fk->i", SG, inverse, St) - np.einsum("kji,fkj->i", G, Mt)
        if np.linalg.eigvalsh(N[:6, :6])[0] < 1e-9:
            return None
        if iteration == 0:  # in metres, not in radians: no prior can be weighed against it
            y[:6] = _with_gravity(N[:6, :6], b[:6]) if gravity is None else np.concatenate(
                [scale * np.linalg.solve(N[:3, :3], b[:3] - N[:3, 3:6] @ gravity), gravity])
        else:
            y = _with_gravity(N + prior, b, y[3:6])
        v = (np.einsum("fij,fj->fi", inverse, SG @ y + St)[:, None] - G @ y - e)
        distance = np.maximum(np.linalg.norm(v, axis=2), 0.01)
        u = v / distance[..., None]
        cosine = (u * rays).sum(axis=2)
        off2 = np.maximum(1.0 - cosine**2, 0.0)
        bad = np.where(seen & (cosine < 0.0), 1.0, np.where(seen, off2, 0.0)).sum(axis=1) / seen.sum(axis=1) > (4.0 * sigma) ** 2
        used = seen if iteration < 2 or (~bad).sum() < _MIN_FEATURES else seen & ~bad[:, None]  # not points of the static world
    if (used & (cosine < 0.5)).any():
        return None
    rms2 = off2[used].mean()
    cost = float((np.minimum(off2, (4.0 * sigma) ** 2)[seen]).sum() / sigma**2 + (y[6:] ** 2).sum() / bias_sigma**2)
    covariance = np.linalg.inv(N / (2.0 * sigma) ** 2 + prior / sigma**2)
    return cost, MotionSolution(y[:3], y[3:6], y[6:], covariance, float(np.sqrt(rms2)))


def _with_gravity(N: np.ndarray, b: np.ndarray, g: np.ndarray | None = None) -> np.ndarray:
    """Minimise y^T N y - 2 b^T y over (v, g, ...) with |g| = GRAVITY: Gauss-Newton on the sphere from g or the free solution."""
    if g is None:
        y = np.linalg.solve(N, b)
        g = y[3:6] if np.linalg.norm(y[3:6]) > 1e-6 else np.array([0.0, 0.0, -1.0])
    n = len(N)
    for _ in range(8):
        g = g * (GRAVITY / np.linalg.norm(g))
        u = np.linalg.svd(g[None])[2][1:].T  # tangent plane of the sphere
        J = np.zeros((n, n - 1))
        J[:3, :3], J[3:6, 3:5], J[6:, 5:] = np.eye(3), u, np.eye(n - 6)
        step = np.linalg.solve(J.T @ N @ J, J.T @ (b - N[:, 3:6] @ g))
        g = g + u @ step[3:5]
    return np.concatenate([step[:3], g * (GRAVITY / np.linalg.norm(g)), step[5:]])


class MotionStart:
    """Collects frames until they determine the gyro's bias, velocity and gravity.

    Attributes:
        gyro_bias: latest estimate [rad/s], shape (3,).
        gyro_sigma: 1 sigma of each of its components [rad/s].
    """

    def __init__(self, config: VioConfig, mount: CameraMount, gyro_bias: np.ndarray | None = None) -> None:
        """
        Args:
            config: all settings.
            mount: the camera as calibrated.
            gyro_bias: estimate of an earlier filter [rad/s], shape (3,); None: there is none.
        """
        self._config, self._mount = config, mount
        self._tracks, self._next = Tracks(), 0
        self._stamps: dict[int, int] = {}
        self.gyro_bias = self._known_bias = np.zeros(3) if gyro_bias is None else gyro_bias
        self.gyro_sigma = config.imu.gyro_bias_init

    def add(self, frame: int, stamp: int, ids: np.ndarray, bearings: Bearings) -> None:
        """Add a frame: number, exposure on the IMU's clock [ns], feature numbers (n,) and bearings."""
        self._tracks.take_ended(ids)
        self._tracks.observe(frame, ids, bearings)
        self._stamps[frame] = stamp
        oldest = stamp - round(1e9 * _LONGEST * DURATION)
        self._stamps = {f: s for f, s in self._stamps.items() if s >= oldest}
        self._tracks.forget_before(min(self._stamps))

    def solve(self, imu: ImuBuffer, known: Callable[[np.ndarray], KnownPose]) -> State | None:
        """Return a state at the newest frame, or None while there is too little motion, time or texture.

        Args:
            imu: samples over all frames.
            known: returns the known position and heading at the newest frame for a gyro bias (3,).
        """
        if max(self._stamps.values()) < self._next:
            return None
        for stretch in (1.0, _LONGEST):  # as short as it can be: tracks end, and noise grows
            frames = self._frames(imu, stretch * DURATION)
            state = None if frames is None else self._solve(frames, imu, known)
            if state is not None:
                return state
        return None

    def _frames(self, imu: ImuBuffer, duration: float) -> list[int] | None:
        """Frames over the last `duration` [s], evenly thinned; None where there are not enough."""
        newest = max(self._stamps.values())
        frames = [f for f, s in sorted(self._stamps.items()) if s >= max(newest - round(1e9 * duration), imu.oldest)]
        if len(frames) < _LEAST_FRAMES or (newest - self._stamps[frames[0]]) * 1e-9 < 0.85 * duration:
            return None
        chosen = np.unique(np.round(np.linspace(0, len(frames) - 1, min(len(frames), _MOST_FRAMES))).astype(int))
        return [frames[k] for k in chosen]

    def _solve(self, frames: list[int], imu: ImuBuffer, known: Callable[[np.ndarray], KnownPose]) -> State | None:
        place = {f: k for k, f in enumerate(frames)}
        rays, seen = [], []
        for track in self._tracks.by_id.values():
            sights = [(place[f], b) for f, b in zip(track.frames, track.b_C) if f in place]
            if len(sights) >= _LEAST_FRAMES:
                seen.append(np.array([k for k, _ in sights]))
                rays.append(np.array([b for _, b in sights]) @ self._mount.R_BC.T)
        if len(rays) < _MIN_FEATURES:
            return None
        sigma = _TRACK_NOISE / self._mount.camera.fx
        self._find_gyro_bias(frames, imu, rays, seen, sigma)
        if self.gyro_sigma > _GYRO_SIGMA:
            return None
        parts = [preintegrate(imu.run(self._stamps[frames[0]], self._stamps[f]), self.gyro_bias, np.zeros(3)) for f in frames]
        dR, there = np.array([p.dR for p in parts]), np.zeros((len(rays), len(frames)), bool)
        all_rays = np.broadcast_to([0.0, 0.0, 1.0], (*there.shape, 3)).copy()
        for row, (k, d) in enumerate(zip(seen, rays)):
            there[row, k], all_rays[row, k] = True, np.einsum("nij,nj->ni", dR[k], d)
        ends = solve_motion(
            np.array([p.duration for p in parts]), np.array([p.dp for p in parts]), parts[-1].dv, np.array([p.J[3:6, 3:] for p in parts]),
            dR @ self._mount.p_BC, all_rays, there, sigma, self._config.imu.accel_bias_init)
        steps = [imu.run(self._stamps[i], self._stamps[j]) for i, j in zip(frames[:-1], frames[1:])]
        refined: list[Refined] = []
        self._next = self._stamps[frames[-1]] + round(1e9 * _PAUSE * DURATION)
        for end in ends:
            x = self._refined(end, parts, steps, place) if end.residual < 2 * sigma else None
            if x is not None and x.scale > 2.0 * _SCALE:
                return None  # no other minimum will make this motion tell more
            refined += [] if x is None else [x]
        best = min(refined, key=lambda x: x.cost, default=None)
        if best is None or best.misfit > _MISFIT or best.kept < _KEPT or best.scale > _SCALE:
            return None
        if any(x.cost < best.cost + _RIVAL and x.is_distinct_from(best) for x in refined):
            return None
        return self._state(best, known(best.gyro_bias), self._stamps[frames[-1]])

    def _refined(self, end: MotionSolution, parts: list[Preintegration], steps: list[np.ndarray], place: dict[int, int]) -> Refined | None:
        R_WB = start.levelled(np.eye(3), -end.g)
        sights = self._sights(R_WB, end, parts, place)
        if len(sights) < _MIN_FEATURES:
            return None
        return refine(self._config, self._mount, steps, sights, R_WB, R_WB @ end.v, self.gyro_bias, end.accel_bias, self._known_bias)

    def _sights(self, R_WB: np.ndarray, found: MotionSolution, parts: list[Preintegration], place: dict[int, int]) -> list[PointObservations]:
        """Return the tracks with parallax, their points triangulated along the motion found."""
        R = np.array([R_WB @ p.dR for p in parts])
        p = np.array([found.v * p.duration + 0.5 * found.g * p.duration**2 + p.dp + p.J[3:6, 3:] @ found.accel_bias for p in parts]) @ R_WB.T
        centres, out = p + R @ self._mount.p_BC, []
        for track in self._tracks.by_id.values():
            ks = [k for k, f in enumerate(track.frames) if f in place]
            if len(ks) < _LEAST_FRAMES:
                continue
            js = np.array([place[track.frames[k]] for k in ks])
            b_C = np.array([track.b_C[k] for k in ks])
            X = triangulate(centres[js], np.einsum("nij,nj->ni", R[js] @ self._mount.R_BC, b_C), np.radians(_PARALLAX_DEG),
                            2.0 * _TRACK_NOISE / self._mount.camera.fx)
            if X is not None:
                out.append(PointObservations(js, Bearings(b_C, np.array([track.shape[k] for k in ks])), X))
        return sorted(out, key=lambda sight: -len(sight.frames))[:_MOST_POINTS]

    def _find_gyro_bias(self, frames: list[int], imu: ImuBuffer, rays: list[np.ndarray], seen: list[np.ndarray], sigma: float) -> None:
        """Update the gyro's bias from pairs of frames half the stretch apart; no frame is in more than one pair."""
        half, pairs = len(frames) // 2, []
        for i in range(half):
            j = i + half
            both = [(d[k == i][0], d[k == j][0]) for d, k in zip(rays, seen) if i in k and j in k]
            if len(both) >= _MIN_FEATURES:
                part = preintegrate(imu.run(self._stamps[frames[i]], self._stamps[frames[j]]), self.gyro_bias, np.zeros(3))
                first, second = np.array(both).swapaxes(0, 1)
                pairs.append(RayPair(part.dR, part.J[:3, :3], first, second))
        step, P = solve_gyro_bias(pairs, sigma, self._config.imu.gyro_bias_init)
        self.gyro_bias, self.gyro_sigma = self.gyro_bias + step, largest_sigma(P)

    def _state(self, found: Refined, pose: KnownPose, stamp: int) -> State | None:
        """Return the state at the end of the stretch, with heading and position of `pose`; None where it is too uncertain."""
        R_WB, v_B, P = start.levelled(pose.R_WB, found.R_WB[2]), found.v_B, found.covariance
        turned = R_WB @ so3.hat(v_B)
        if largest_sigma(P[:3, :3]) > _TILT or largest_sigma(P[3:6, 3:6]) > _SPEED:
            return None
        state = start.initial_state(self._config, self._mount, stamp, R_WB, pose, R_WB @ v_B, found.gyro_bias, 0.0, 0.0, 0.0)
        state.accel_bias, state.R_BC, state.p_BC = found.accel_bias, found.R_BC, found.p_BC
        state.time_offset += found.time_offset
        rows = np.r_[at.THETA, at.VELOCITY, 9:at.CORE_SIZE]
        lens = state.P[at.LENS, at.LENS].copy()
        # v_W = R (v_B + dv_B), and turns with the attitude: by the error of the tilt and by that of the heading
        to_W = np.eye(len(rows))
        to_W[3:6, 3:6], to_W[3:6, :3] = R_WB, -turned
        state.P[at.VELOCITY] = -turned @ state.P[at.THETA]
        state.P[:, at.VELOCITY] = -state.P[:, at.THETA] @ turned.T
        state.P[9:, 9:] = 0.0
        state.P[np.ix_(rows, rows)] += to_W @ P @ to_W.T
        state.P[at.LENS, at.LENS] = lens  # considered, not estimated
        start.add_heading_by_bias(state, pose)
        return state
