"""Start in motion: gravity, velocity and scale from the IMU and the tracks of about half a second, in closed form.

In the body frame B0 of the first frame, with preintegrated dR, dp and p_k = v0 T + g0 T^2/2 + dp_k, every observation says
that the point lies on its ray:  (I - d d^T)(X_j - p_k - dR_k p_BC) = 0,  d = dR_k R_BC b.  That is linear in v0, g0 and all
X_j; the points are eliminated, and the 6 x 6 rest is solved with |g0| = g. (Dong-Si and Mourikis 2012.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from perch_core.camera import CameraMount
from perch_core.covariance import largest_sigma
from perch_core.vehicle import GRAVITY

from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.vio import start
from perch_perception.vio.bearing import Bearings
from perch_perception.vio.config import VioConfig
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.start import KnownPose
from perch_perception.vio.state import State
from perch_perception.vio.tracks import Tracks

_LEAST_FEATURES = 12
_LEAST_FRAMES = 6


@dataclass(frozen=True)
class MotionSolution:
    """Velocity and gravity in B0 (3,), covariance of both stacked (6, 6), and the mean residual [rad]."""

    v: np.ndarray
    g: np.ndarray
    covariance: np.ndarray
    residual: float


def solve_motion(T: np.ndarray, dp: np.ndarray, centres: np.ndarray, rays: list[np.ndarray], frames: list[np.ndarray],
                 sigma: float) -> MotionSolution | None:
    """Velocity and gravity from rays.

    Args:
        T: time since the first frame [s], shape (n,).
        dp: preintegrated positions in B0 [m], shape (n, 3).
        centres: dR_k p_BC, camera centres relative to the body in B0 [m], shape (n, 3).
        rays: for each feature its unit rays in B0, shape (m_j, 3).
        frames: for each feature the frames of its rays, shape (m_j,).
        sigma: 1 sigma of a ray [rad].

    Returns:
        None where the motion does not tell velocity and gravity.
    """
    weights = [np.ones(len(f)) for f in frames]
    y = np.zeros(6)
    for _ in range(3):
        N, b, systems = np.zeros((6, 6)), np.zeros(6), []
        for d, k, w in zip(rays, frames, weights):
            M = (np.eye(3) - d[:, :, None] * d[:, None, :]) * w[:, None, None]
            G = np.zeros((len(k), 3, 6))
            G[:, :, :3] = T[k, None, None] * np.eye(3)
            G[:, :, 3:] = 0.5 * T[k, None, None] ** 2 * np.eye(3)
            e = dp[k] + centres[k]
            MG, Me = M @ G, np.einsum("nij,nj->ni", M, e)
            A = M.sum(axis=0)
            if np.linalg.eigvalsh(A)[0] < 1e-6 * np.trace(A):
                continue  # no parallax yet: nothing to learn from this feature
            A_inv = np.linalg.inv(A)
            SG, Se = MG.sum(axis=0), Me.sum(axis=0)
            N += np.einsum("nji,njk->ik", G, MG) - SG.T @ A_inv @ SG
            b -= np.einsum("nji,nj->i", G, Me) - SG.T @ A_inv @ Se
            systems.append((A_inv, SG, Se, G, e, d, k))
        if len(systems) < _LEAST_FEATURES or np.linalg.eigvalsh(N)[0] < 1e-9:
            return None
        y = _with_gravity(N, b)
        weights, rays, frames, residuals = [], [], [], []
        for A_inv, SG, Se, G, e, d, k in systems:
            v = A_inv @ (SG @ y + Se) - G @ y - e
            distance = np.maximum(np.linalg.norm(v, axis=1), 0.05)
            off = np.linalg.norm(v - d * np.sum(v * d, axis=1, keepdims=True), axis=1) / distance
            if np.sqrt(np.mean(off**2)) > 8 * sigma and len(systems) > 2 * _LEAST_FEATURES:
                continue  # not a point of the static world
            residuals.append(off)
            weights.append(1.0 / distance**2)
            rays.append(d)
            frames.append(k)
    covariance = sigma**2 * np.linalg.inv(N)
    return MotionSolution(y[:3], y[3:], covariance, float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))))


def _with_gravity(N: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Minimise y^T N y - 2 b^T y over (v, g) with |g| = GRAVITY: Gauss-Newton on the sphere from the free solution."""
    y = np.linalg.solve(N, b)
    g = y[3:] if np.linalg.norm(y[3:]) > 1e-6 else np.array([0.0, 0.0, -1.0])
    for _ in range(8):
        g = g * (GRAVITY / np.linalg.norm(g))
        u = np.linalg.svd(g[None])[2][1:].T  # tangent plane of the sphere
        J = np.zeros((6, 5))
        J[:3, :3], J[3:, 3:] = np.eye(3), u
        step = np.linalg.solve(J.T @ N @ J, J.T @ (b - N @ np.concatenate([np.zeros(3), g])))
        y = np.concatenate([step[:3], g + u @ step[3:]])
        g = y[3:]
    return np.concatenate([y[:3], g * (GRAVITY / np.linalg.norm(g))])


class MotionStart:
    """Gathers frames until they tell velocity and gravity."""

    def __init__(self, config: VioConfig, mount: CameraMount) -> None:
        self._config, self._mount = config, mount
        self._tracks, self._stamps = Tracks(), {}

    def add(self, frame: int, stamp: int, ids: np.ndarray, bearings: Bearings) -> None:
        """Take a frame: number, exposure on the IMU's clock [ns], feature numbers (n,) and bearings."""
        self._tracks.take_ended(ids)
        self._tracks.observe(frame, ids, bearings)
        self._stamps[frame] = stamp
        oldest = stamp - round(1e9 * self._config.start.motion_time)
        self._stamps = {f: s for f, s in self._stamps.items() if s >= oldest}
        self._tracks.forget_before(min(self._stamps))

    def solve(self, imu: ImuBuffer, pose: KnownPose, gyro_bias: np.ndarray) -> State | None:
        """A state at the newest frame, or None while there is too little motion, time or texture.

        Args:
            imu: samples over all frames.
            pose: position and heading at the newest frame, as far as they are known.
            gyro_bias: last known [rad/s], shape (3,).
        """
        frames = sorted(self._stamps)
        if len(frames) < _LEAST_FRAMES or self._span(frames) < 0.85 * self._config.start.motion_time:
            return None
        if self._stamps[frames[0]] < imu.oldest:
            return None
        place = {f: k for k, f in enumerate(frames)}
        parts = [preintegrate(imu.run(self._stamps[frames[0]], self._stamps[f]), gyro_bias, np.zeros(3)) for f in frames]
        T = np.array([p.duration for p in parts])
        dR, dp = np.array([p.dR for p in parts]), np.array([p.dp for p in parts])
        R_C = dR @ self._mount.R_BC
        rays, seen = [], []
        for track in self._tracks.by_id.values():
            k = np.array([place[f] for f in track.frames if f in place], int)
            if len(k) >= _LEAST_FRAMES:
                rays.append(np.einsum("nij,nj->ni", R_C[k], np.array(track.b_C[-len(k):])))
                seen.append(k)
        if len(rays) < _LEAST_FEATURES:
            return None
        sigma = self._config.start.motion_noise / self._mount.camera.fx
        found = solve_motion(T, dp, dR @ self._mount.p_BC, rays, seen, sigma)
        if found is None or found.residual > 4 * sigma:
            return None
        return self._state(found, parts, pose, gyro_bias, self._stamps[frames[-1]])

    def _span(self, frames: list[int]) -> float:
        return (self._stamps[frames[-1]] - self._stamps[frames[0]]) * 1e-9

    def _state(self, found: MotionSolution, parts: list, pose: KnownPose, gyro_bias: np.ndarray, stamp: int) -> State | None:
        last = parts[-1]
        # twice the formal figure: biases and the IMU's noise are not in it
        tilt = 2 * largest_sigma(found.covariance[3:, 3:]) / GRAVITY
        speed = 2 * largest_sigma(found.covariance[:3, :3])
        if tilt > 0.2 or speed > 0.5:
            return None
        bias_tilt = self._config.imu.accel_bias_init / GRAVITY
        up_B = last.dR.T @ (-found.g / GRAVITY)
        R_WB = start.levelled(pose.R_WB, up_B)
        v_B0 = found.v + found.g * last.duration + last.dv
        return start.fresh(self._config, self._mount, stamp, R_WB, pose, R_WB @ (last.dR.T @ v_B0), gyro_bias.copy(),
                           float(np.hypot(tilt, bias_tilt)), float(np.hypot(speed, 0.1)), self._config.imu.gyro_bias_init)
