"""Maximum a posteriori refinement of a start in motion: all unknowns at once, each with its own noise or prior.

The closed form (`motion_start`) takes the gyro's bias, the calibration and the IMU's readings as exact. Over half a second an
error of 5 mrad/s is 2 px, as much as the parallax that determines the scale: the result may be wrong by several of its sigmas.
From there, Levenberg-Marquardt continues over tilt, velocity and biases at the first frame, the camera's calibration and the
noise of each preintegrated interval, with the points eliminated (Geneva and Huang, OpenVINS State Initialization, 2022; Campos,
Montiel and Tardos 2019). The inverse of its information is the covariance with which the filter starts, with all correlations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.probability import chi2_quantile
from perch_core.vehicle import GRAVITY

from perch_perception.vio import ekf
from perch_perception.vio.bearing import POINT, Bearings, residuals
from perch_perception.vio.bearing import POSITION as BY_POSITION
from perch_perception.vio.bearing import THETA as BY_THETA
from perch_perception.vio.config import VioConfig
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.sliding import TrackWalk

_G = np.array([0.0, 0.0, -GRAVITY])
_ITERATIONS = 10
_CONVERGED = 0.01  # of chi^2
_MIN_POINTS = 6
_DISTINCT_GATE = float(chi2_quantile(0.99, 5))
_TRACK_PROBABILITY = 0.999
# of the unknowns: tilt (2), velocity, biases, calibration, then 9 for the noise of each interval; those with a prior are in its sigmas
_TILT, _VELOCITY, _BIASES, _CALIBRATION, _NOISE = slice(0, 2), slice(2, 5), slice(5, 11), slice(11, 22), 22
_TIME_OFFSET = _CALIBRATION.start + 6


@dataclass(frozen=True)
class PointObservations:
    """Observations of a point: indices of the frames in the stretch, shape (m,), bearings, and position in W, shape (3,)."""

    frames: np.ndarray
    bearings: Bearings
    X_W: np.ndarray


@dataclass(frozen=True)
class Refined:
    """Refined state at the newest frame.

    Attributes:
        R_WB: gravity is along -z of W; the heading is that of the first frame's guess, shape (3, 3).
        v_B: velocity in B [m/s], shape (3,).
        gyro_bias, accel_bias: [rad/s], [m/s^2], shape (3,).
        R_BC, p_BC, time_offset: the camera's extrinsics, and the correction of its time offset [s].
        covariance: of (theta across up, v_B, b_g, b_a, camera rotation and position, time offset, lens), shape (23, 23).
        misfit: chi^2 of all observations used, and of the priors, over the degrees of freedom.
        kept: share of the points that fit.
        scale: 1 sigma of the mean logarithm of the points' distances.
        cost: chi^2 of all points and priors; a point that does not fit counts with the gate's limit.
    """

    R_WB: np.ndarray
    v_B: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_BC: np.ndarray
    p_BC: np.ndarray
    time_offset: float
    covariance: np.ndarray
    misfit: float
    kept: float
    scale: float
    cost: float

    def is_distinct_from(self, other: Refined) -> bool:
        """Whether tilt or velocity differ from those of another by more than both covariances explain."""
        d = np.concatenate([np.cross(self.R_WB[2], other.R_WB[2]), self.v_B - other.v_B])
        return bool(d @ np.linalg.solve(self.covariance[:6, :6] + other.covariance[:6, :6] + 1e-6 * np.eye(6), d) > _DISTINCT_GATE)


@dataclass
class _Unknowns:
    """Current values of the unknowns: state at the first frame, camera, noise of the intervals and points."""

    R_WB: np.ndarray
    v_WB: np.ndarray
    biases: np.ndarray
    R_BC: np.ndarray
    p_BC: np.ndarray
    z: np.ndarray  # all with a prior, in its sigmas; zero elsewhere
    X_W: np.ndarray


@dataclass(frozen=True)
class _Motion:
    """Poses and velocities of all frames, (n, 3, 3), (n, 3), (n, 3), their derivative (n, 9, k), and rates [rad/s], (n, 3)."""

    R_WB: np.ndarray
    p_WB: np.ndarray
    v_WB: np.ndarray
    D: np.ndarray
    w_B: np.ndarray


@dataclass(frozen=True)
class _Linear:
    """Normal equations N dz = b, terms of the points' steps (R_f, H_1, r_1), their chi^2 and degrees of freedom, and the cost."""

    motion: _Motion
    N: np.ndarray
    b: np.ndarray
    points: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    distances: np.ndarray
    dof: np.ndarray
    cost: float


def refine(config: VioConfig, mount: CameraMount, steps: Sequence[np.ndarray], sights: Sequence[PointObservations],
           R_WB: np.ndarray, v_WB: np.ndarray, gyro_bias: np.ndarray, accel_bias: np.ndarray, known_bias: np.ndarray) -> Refined | None:
    """Return the most likely state, from an initial guess.

    Args:
        config: all settings.
        mount: the camera as calibrated.
        steps: IMU steps (m, 9) between neighbouring frames, one for each interval.
        sights: observed points, in W with its origin at the first frame's position.
        R_WB: attitude at the first frame, level by gravity, shape (3, 3).
        v_WB: velocity there [m/s], shape (3,).
        gyro_bias, accel_bias: initial guess, shape (3,).
        known_bias: mean of the gyro bias's prior, shape (3,).

    Returns:
        The state; None where it does not converge to points in front of the cameras.
    """
    sigma = _prior(config, mount)
    z = np.zeros(_NOISE + 9 * len(steps))
    s = _Unknowns(R_WB, v_WB, np.concatenate([gyro_bias, accel_bias]), mount.R_BC, mount.p_BC, z, np.array([x.X_W for x in sights]))
    z[_BIASES] = (s.biases - np.concatenate([known_bias, np.zeros(3)])) / sigma[:6]
    track_walk = TrackWalk(config, mount.camera.fx)
    variance = (config.calibration.track / mount.camera.fx) ** 2
    used = np.ones(len(sights), bool)
    while True:
        linearised = partial(_linearised, steps=steps, sights=sights, used=used, track_walk=track_walk, variance=variance, sigma=sigma)
        end = _descend(s, linearised, sigma, used)
        if end is None:
            return None
        s, here = end
        good = used.copy()
        good[used] = here.distances < chi2_quantile(_TRACK_PROBABILITY, here.dof)
        if (good == used).all():
            break
        used = good
        if used.sum() < _MIN_POINTS:
            return None
    misfit = (here.distances.sum() + s.z @ s.z) / (here.dof.sum() - 5)
    m = np.array([len(x.frames) for x in sights])[~used]
    return _at_the_end(s, here, used, sigma, float(misfit), here.cost + float(chi2_quantile(_TRACK_PROBABILITY, 2 * m - 3).sum()))


def _descend(s: _Unknowns, linearise: Callable[[_Unknowns], _Linear | None], sigma: np.ndarray,
             used: np.ndarray) -> tuple[_Unknowns, _Linear] | None:
    """Minimise by Levenberg-Marquardt from the unknowns `s`; return None where it does not converge."""
    here, damping = linearise(s), 1e-4
    if here is None:
        return None
    for _ in range(_ITERATIONS):
        N = here.N.copy()
        N.flat[:: len(N) + 1] *= 1.0 + damping
        step = np.linalg.solve(N, here.b)
        onward = _moved(s, step, sigma, here.points, used)
        there = linearise(onward)
        if there is None or there.cost > here.cost + _CONVERGED:
            damping *= 10.0
            continue
        gained, s, here, damping = here.cost - there.cost, onward, there, 0.1 * damping
        if gained < _CONVERGED:  # also where rounding makes it a little worse
            return s, here
    return None


def _prior(config: VioConfig, mount: CameraMount) -> np.ndarray:
    """Return the prior 1 sigma of biases and calibration, shape (17,)."""
    c, imu = config.calibration, config.imu
    return np.concatenate([
        np.repeat([imu.gyro_bias_init, imu.accel_bias_init, c.rotation, c.translation], 3),
        [c.time_offset, c.focal, c.focal, c.centre / mount.camera.fx, c.centre / mount.camera.fy]])


def _integrate(s: _Unknowns, steps: Sequence[np.ndarray], sigma: np.ndarray) -> _Motion:
    """Integrate the motion from the first frame on, with its derivatives with respect to the unknowns."""
    n, k = len(steps) + 1, len(s.z)
    R, p, v, w = np.empty((n, 3, 3)), np.zeros((n, 3)), np.empty((n, 3)), np.zeros((n, 3))
    D = np.zeros((n, 9, k))  # of theta, p, v
    R[0], v[0] = s.R_WB, s.v_WB
    D[0, :3, _TILT], D[0, 6:, _VELOCITY] = _tilt_axes(s.R_WB), np.eye(3)
    for i, rows in enumerate(steps):
        pre = preintegrate(rows, s.biases[:3], s.biases[3:])
        T = pre.duration
        L = np.linalg.cholesky(pre.Q + max(1e-18, 1e-15 * pre.Q.max()) * np.eye(9))  # one long step, over a gap, makes Q singular
        own = slice(_NOISE + 9 * i, _NOISE + 9 * (i + 1))
        xi = L @ s.z[own]  # of log dR, dp, dv
        dR, dp, dv = pre.dR @ so3.exp(xi[:3]), pre.dp + xi[3:6], pre.dv + xi[6:]
        R[i + 1] = R[i] @ dR
        p[i + 1] = p[i] + v[i] * T + 0.5 * _G * T * T + R[i] @ dp
        v[i + 1] = v[i] + _G * T + R[i] @ dv
        theta, place, speed = D[i, :3], D[i, 3:6], D[i, 6:]
        D[i + 1, :3] = dR.T @ theta
        D[i + 1, 3:6] = place + T * speed - R[i] @ so3.hat(dp) @ theta
        D[i + 1, 6:] = speed - R[i] @ so3.hat(dv) @ theta
        G = np.zeros((9, 9))
        G[:3, :3], G[3:6, 3:6], G[6:, 6:] = np.eye(3), R[i], R[i]
        D[i + 1, :, _BIASES] += G @ pre.J * sigma[:6]
        D[i + 1, :, own] += G @ L
        w[i + 1] = pre.w_end
    w[0] = steps[0][0, 1:4] - s.biases[:3]
    return _Motion(R, p, v, D, w)


def _tilt_axes(R_WB: np.ndarray) -> np.ndarray:
    """Return two rotation vectors in B orthogonal to up, i.e. the turns that gravity makes observable, shape (3, 2)."""
    return R_WB.T[:, :2]


def _linearised(s: _Unknowns, steps: Sequence[np.ndarray], sights: Sequence[PointObservations], used: np.ndarray,
                track_walk: TrackWalk, variance: float, sigma: np.ndarray) -> _Linear | None:
    """Return the normal equations at given unknowns; None where a point is not in front of a camera."""
    motion = _integrate(s, steps, sigma)
    chosen = [x for x, ok in zip(sights, used) if ok]
    f = np.concatenate([x.frames for x in chosen])
    count = np.array([len(x.frames) for x in chosen])
    X = np.repeat(s.X_W[used], count, axis=0)
    seen = Bearings(np.concatenate([x.bearings.b_C for x in chosen]), np.concatenate([x.bearings.shape for x in chosen]))
    now = residuals(motion.R_WB[f], motion.p_WB[f], X, s.R_BC, s.p_BC, seen)
    if (now.cosine < 0.5).any():
        return None
    offset = float(s.z[_TIME_OFFSET])
    D = motion.D[:, :6].copy()
    D[:, :3, _TIME_OFFSET] += motion.w_B * sigma[12]
    D[:, 3:, _TIME_OFFSET] += motion.v_WB * sigma[12]
    pose = np.concatenate([now.J[:, :, BY_THETA], now.J[:, :, BY_POSITION]], axis=2)
    A = np.empty((len(f), 2, 3 + len(s.z) + 1))
    A[:, :, :3] = now.J[:, :, POINT]
    A[:, :, 3:-1] = pose @ D[f]
    A[:, :, 3 + _CALIBRATION.start : 3 + _CALIBRATION.stop] += now.J[:, :, :11] * sigma[6:]
    # the poses are integrated to the stamps: what the offset does to them, and the lens to the bearings, is linear
    lens = s.z[_CALIBRATION.start + 7 : _CALIBRATION.stop] * sigma[13:]
    moved = pose @ np.concatenate([motion.w_B, motion.v_WB], axis=1)[f][:, :, None] * (offset * sigma[12])
    A[:, :, -1] = now.r - moved[:, :, 0] - now.J[:, :, 7:11] @ lens
    walk = track_walk.steps(seen.b_C[:-1], seen.b_C[1:], now.distance[:-1], now.distance[1:])
    rows, rests, points, ends = [], [], [], np.cumsum(count)
    for begin, end in zip(ends - count, ends):
        white = track_walk.whitened(walk[begin : end - 1], now.distance[begin:end], A[begin:end].reshape(end - begin, -1))
        white = white.reshape(2 * (end - begin), -1)
        R_f, H_1, r_1, H_0, r_0 = ekf.eliminate(white[:, 3:-1], white[:, :3], white[:, -1])
        rows.append(H_0)
        rests.append(r_0)
        points.append((R_f, H_1, r_1))
    H, r = np.concatenate(rows), np.concatenate(rests)
    N, b = H.T @ H / variance, H.T @ r / variance
    N.flat[(len(N) + 1) * _BIASES.start :: len(N) + 1] += 1.0
    b -= s.z
    distances = np.array([float(r_0 @ r_0) for r_0 in rests]) / variance
    return _Linear(motion, N, b, points, distances, 2 * count - 3, float(distances.sum() + s.z @ s.z))


def _moved(s: _Unknowns, step: np.ndarray, sigma: np.ndarray, points: list, used: np.ndarray) -> _Unknowns:
    """Return the unknowns, points included, after a step."""
    X_W, z = s.X_W.copy(), s.z.copy()
    for j, (R_f, H_1, r_1) in zip(np.flatnonzero(used), points):
        X_W[j] += np.linalg.solve(R_f, r_1 - H_1 @ step)
    z[_BIASES.start :] += step[_BIASES.start :]
    camera = step[_CALIBRATION] * sigma[6:]
    return _Unknowns(s.R_WB @ so3.exp(_tilt_axes(s.R_WB) @ step[_TILT]), s.v_WB + step[_VELOCITY], s.biases + step[_BIASES] * sigma[:6],
                     s.R_BC @ so3.exp(camera[:3]), s.p_BC + camera[3:6], z, X_W)


def _at_the_end(s: _Unknowns, here: _Linear, used: np.ndarray, sigma: np.ndarray, misfit: float, cost: float) -> Refined:
    """Return state and covariance at the last frame."""
    motion = here.motion
    R, v, D = motion.R_WB[-1], motion.v_WB[-1], motion.D[-1]
    v_B, up_B = R.T @ v, R[2]
    J = np.zeros((24, len(s.z)))
    J[:3] = (np.eye(3) - np.outer(up_B, up_B)) @ D[:3]
    J[3:6] = R.T @ D[6:] + so3.hat(v_B) @ D[:3]
    J[6:12, _BIASES] = np.diag(sigma[:6])
    J[12:23, _CALIBRATION] = np.diag(sigma[6:])
    for X, (R_f, H_1, _) in zip(s.X_W[used], here.points):
        ray = X - motion.p_WB[-1]
        J[23] += ray / (ray @ ray) @ (-np.linalg.solve(R_f, H_1) - D[3:6]) / used.sum()
    P = max(1.0, misfit) * J @ np.linalg.solve(here.N, J.T)
    return Refined(R, v_B, s.biases[:3], s.biases[3:], s.R_BC, s.p_BC, float(s.z[_TIME_OFFSET] * sigma[12]), P[:23, :23], misfit,
                   float(used.mean()), float(np.sqrt(P[23, 23])), cost)
