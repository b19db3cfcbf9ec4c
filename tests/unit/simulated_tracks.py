"""Exact IMU and exact tracks with declared noise: what VIO's filter must be consistent with.

Nothing here is rendered or flown. The truth is what the IMU's exact readings integrate to; biases walk, and noises are drawn, as the
filter's settings say, or as a mismatch says. With what is declared, the NEES of every part of the state is 1 per dimension.

    python tests/unit/simulated_tracks.py --draws 12
    python tests/unit/simulated_tracks.py --time-inside 200
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.values import ImuSample
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.vio import VioConfig
from perch_perception.vio import state as at
from perch_perception.vio.bearing import observe
from perch_perception.vio.msckf import Msckf
from perch_perception.vio.state import State

_G = np.array([0.0, 0.0, -GRAVITY])
_STEP = 1e-3  # of the differences that differentiate a path [s]
_OFFSET = 0.008  # the camera's time offset as calibrated [s]
_START = np.repeat([0.005, 0.001, 0.02, 0.001, 0.05], 3)  # 1 sigma of theta [rad], p [m], v [m/s], b_g [rad/s], b_a [m/s^2] at the start
PARTS = {"attitude": slice(0, 3), "position": slice(3, 6), "velocity": slice(6, 9), "gyro bias": slice(9, 12), "accelerometer bias": slice(12, 15)}

Path = Callable[[np.ndarray], np.ndarray]  # times (n,) to positions (n, 3)


def _waves(amplitudes: list[float], rates: list[float], phases: np.ndarray, height: float) -> Path:
    return lambda t: np.array(amplitudes) * np.sin(np.multiply.outer(t, rates) + phases[:3]) + [0.0, 0.0, height]


def _rise(x: np.ndarray) -> np.ndarray:
    """0 to 1 over [0, 1] with four derivatives zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**5 * (126 + x * (-420 + x * (540 + x * (-315 + 70 * x))))


def motion(name: str, rng: np.random.Generator) -> tuple[Path, float]:
    """A path and the amplitude of the turns about it [rad]: `circle`, `hand`, `eight`, `far`, `climb` or `slow`."""
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    if name == "circle":
        return lambda t: np.stack([np.cos(1.6 * t + phases[0]), np.sin(1.6 * t + phases[0]), 1.5 + 0.0 * t], -1), 0.0
    if name == "hand":
        return _waves([0.6, 0.5, 0.3], [1.9, 1.6, 2.3], phases, 1.5), 0.3
    if name == "eight":
        return _waves([1.2, 0.8, 0.5], [1.2, 2.4, 0.9], phases, 1.8), 0.15
    if name == "far":
        ahead, beside = np.array([15.0, 0.0, 0.0]), _waves([0.0, 1.0, 0.5], [1.0, 0.8, 0.6], phases, 3.0)
        return lambda t: beside(t) + _rise(t / 8.0)[:, None] * ahead, 0.0
    if name == "climb":
        up, sway = np.array([0.0, 0.0, 2.2]), _waves([0.05, 0.05, 0.0], [1.3, 1.1, 1.0], phases, 0.3)
        return lambda t: sway(t) + _rise((t - 0.5) / 4.0)[:, None] * up, 0.0
    if name == "slow":
        return _waves([0.5, 0.4, 0.2], [0.6, 0.5, 0.7], phases, 1.5), 0.1
    raise ValueError(f"motion {name!r} is not one of circle, hand, eight, far, climb, slow")


class Truth:
    """What exact readings of rate and force, constant over the IMU's periods, integrate to: thrust along z of B, as of a multicopter."""

    def __init__(self, name: str, rng: np.random.Generator, rate: float, duration: float) -> None:
        path, turns = motion(name, rng)
        self._rate, h = rate, 1.0 / rate
        self._t = t = np.arange(round(duration * rate) + 1) * h
        self._v = (path(t + _STEP) - path(t - _STEP)) / (2.0 * _STEP)
        self._a = np.diff(self._v, axis=0) / h
        steps = self._v[:-1] * h + 0.5 * self._a * h * h
        self._p = path(t[:1]) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        up = (path(t + _STEP) - 2.0 * path(t) + path(t - _STEP)) / _STEP**2 - _G
        axis = np.stack([-up[:, 1], up[:, 0], 0.0 * t], -1)
        sine = np.maximum(np.linalg.norm(axis, axis=1), 1e-12)
        tilt = Rotation.from_rotvec(axis * (np.arctan2(sine, up[:, 2]) / sine)[:, None])
        turn = turns * np.sin(np.multiply.outer(t, [2.1, 1.7, 1.3]) + rng.uniform(0.0, 2.0 * np.pi, 3))
        q = tilt * Rotation.from_rotvec(turn)
        self._R = q.as_matrix()
        self.w_B = (q[:-1].inv() * q[1:]).as_rotvec() / h
        self.f_B = np.einsum("nji,nj->ni", self._R[:-1] @ so3.exp(0.5 * h * self.w_B), self._a - _G)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest coordinates of the path [m], shapes (3,)."""
        return self._p.min(axis=0), self._p.max(axis=0)

    def step(self, t: float) -> int:
        """The IMU's period in which a time [s] lies."""
        return min(int(t * self._rate + 1e-9), len(self.w_B) - 1)

    def at(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_WB (3, 3), p_WB and v_WB (3,) at a time [s]."""
        k = self.step(t)
        u = t - self._t[k]
        return (self._R[k] @ so3.exp(self.w_B[k] * u), self._p[k] + self._v[k] * u + 0.5 * self._a[k] * u * u,
                self._v[k] + self._a[k] * u)


class Tracks:
    """Points on floor, walls and ceiling around a path, seen with noise: tracks without images."""

    def __init__(self, rng: np.random.Generator, truth: Truth, mount: CameraMount, noise: Callable[[int], np.ndarray], count: int = 60) -> None:
        self._rng, self._mount, self._noise, self._count = rng, mount, noise, count
        low, high = truth.bounds
        low, high = np.array([low[0] - 3.0, low[1] - 3.0, 0.0]), high + [3.0, 3.0, 2.0]
        x, y, z = high - low
        share = np.array([y * z, y * z, x * z, x * z, x * y, x * y])
        self._points = rng.uniform(low, high, (4000, 3))
        face = rng.choice(6, 4000, p=share / share.sum())
        self._points[np.arange(4000), face // 2] = np.where(face % 2, high[face // 2], low[face // 2])
        self._active: dict[int, int] = {}
        self._next = 0

    def __call__(self, R_WB: np.ndarray, p_WB: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n,) and pixels (n, 2) of what is seen from a pose. A track in fifty ends."""
        X_C = ((self._points - p_WB) @ R_WB - self._mount.p_BC) @ self._mount.R_BC
        pixels, seen = self._mount.camera.project(X_C)
        distance = np.linalg.norm(X_C, axis=1)
        seen &= self._mount.camera.contains(pixels, 8) & (X_C[:, 2] > np.cos(1.3) * distance) & (distance > 0.15)
        self._active = {k: i for k, i in self._active.items() if seen[k] and self._rng.uniform() > 0.02}
        fresh = self._rng.permutation(np.setdiff1d(np.flatnonzero(seen), list(self._active)))
        for k in fresh[: max(0, self._count - len(self._active))]:
            self._active[int(k)], self._next = self._next, self._next + 1
        where = np.array(list(self._active), int)
        return np.array(list(self._active.values()), int), pixels[where] + self._noise(len(where))


@dataclass(frozen=True)
class Setting:
    """What is declared and what is true.

    Attributes:
        vio: the filter's settings; its tracks have white noise of `pixel` [px].
        imu: true densities of the IMU's noise over the declared ones.
        pixels: true noise of the tracks over the declared.
        tail: degrees of freedom of a Student t in the place of the tracks' Gaussian, of the same scale; None: Gaussian.
        calibration: whether the camera's calibration is wrong as its priors say; else it is exact, and known to be.
        calibrated: true errors of the calibration over those of its priors.
    """

    vio: VioConfig = field(default_factory=VioConfig)
    pixel: float = 0.3
    imu: float = 1.0
    pixels: float = 1.0
    tail: float | None = None
    calibration: bool = False
    calibrated: float = 1.0
    duration: float = 6.0
    imu_rate: float = 500.0
    frame_rate: float = 20.0

    @property
    def believed(self) -> VioConfig:
        """The filter's settings."""
        prior = replace(self.vio.calibration, track=self.pixel)
        prior = prior if self.calibration else replace(
            prior, rotation=0.0, translation=0.0, time_offset=0.0, focal=0.0, centre=0.0)
        return replace(self.vio, calibration=prior, filter=replace(self.vio.filter, slide_turn=0.0, slide_zoom=0.0))


@dataclass(frozen=True)
class End:
    """Truth minus estimate of (theta, p, v, b_g, b_a) at a frame, shape (15,), and its covariance as the filter believes, shape (15, 15)."""

    error: np.ndarray
    P: np.ndarray

    def nees(self, part: slice) -> float:
        """Normalised estimation error squared of a part of the state, per dimension."""
        e = self.error[part]
        return float(e @ np.linalg.solve(self.P[part, part], e)) / len(e)


def fly(name: str, seed: int, setting: Setting) -> End:
    """The filter at the end of a motion, from a state that is wrong as its covariance says."""
    *_, end = frames(name, seed, setting)
    return end


def frames(name: str, seed: int, setting: Setting) -> Iterator[End]:
    """The same at each frame."""
    rng = np.random.default_rng([seed, *name.encode()])
    config, mount = setting.believed, load_vehicle("snapdragon").mounts["down"]
    truth = Truth(name, rng, setting.imu_rate, setting.duration)
    imu, gyro_bias, accel_bias = _readings(truth, setting, rng)
    c, camera = config.calibration, mount.camera
    sigma = np.concatenate([_START, np.repeat([c.rotation, c.translation], 3),
                            [c.time_offset, c.focal, c.focal, c.centre / camera.fx, c.centre / camera.fy]])
    e = rng.normal(size=at.CORE_SIZE) * sigma
    e[at.INERTIAL_SIZE:] *= setting.calibrated
    offset = _OFFSET + e[at.TIME_OFFSET]
    fx, fy, cx, cy = e[at.LENS]
    real = replace(mount, R_BC=mount.R_BC @ so3.exp(e[at.CAMERA_ROTATION]), p_BC=mount.p_BC + e[at.CAMERA_POSITION], camera=replace(
        camera, fx=camera.fx * (1.0 + fx), fy=camera.fy * (1.0 + fy), cx=camera.cx + cx * camera.fx, cy=camera.cy + cy * camera.fy))
    R, p, v = truth.at(0.0)
    s = State(0, R @ so3.exp(e[at.THETA]).T, p - e[at.POSITION], v - e[at.VELOCITY], -e[at.GYRO_BIAS], -e[at.ACCEL_BIAS],
              mount.R_BC.copy(), mount.p_BC.copy(), _OFFSET, np.diag(sigma**2))
    filter_ = Msckf(config, s, camera.fx)
    scale = setting.pixel * setting.pixels
    tracks = Tracks(rng, truth, real, lambda n: scale * (
        rng.normal(size=(n, 2)) if setting.tail is None else rng.standard_t(setting.tail, (n, 2))))
    for frame in range(round((setting.duration - 0.1) * setting.frame_rate)):
        stamp = 0.02 + frame / setting.frame_rate
        ids, pixels = tracks(*truth.at(stamp + offset)[:2])
        exposed = round((stamp + s.time_offset) * 1e9)
        filter_.propagate(imu.run(s.stamp, exposed), exposed)
        filter_.add_frame(frame, ids, observe(camera, pixels))
        t = s.stamp * 1e-9
        (R, p, v), k = truth.at(t), truth.step(t)
        error = np.concatenate([so3.log(s.R_WB.T @ R), p - s.p_WB, v - s.v_WB, gyro_bias[k] - s.gyro_bias, accel_bias[k] - s.accel_bias])
        yield End(error, s.P[:15, :15].copy())


def _readings(truth: Truth, setting: Setting, rng: np.random.Generator) -> tuple[ImuBuffer, np.ndarray, np.ndarray]:
    """The IMU's samples, and the true biases of gyro and accelerometer at each of its periods, (n, 3)."""
    config, h, shape = setting.believed, 1.0 / setting.imu_rate, truth.w_B.shape
    noise, buffer = config.imu, ImuBuffer(config.imu, 2.0 * setting.duration)
    gyro_bias = np.cumsum(rng.normal(0.0, noise.gyro_bias_walk * np.sqrt(h), shape), axis=0)
    accel_bias = np.cumsum(rng.normal(0.0, noise.accel_bias_walk * np.sqrt(h), shape), axis=0)
    w = truth.w_B + gyro_bias + rng.normal(0.0, setting.imu * noise.gyro_noise_density / np.sqrt(h), shape)
    f = truth.f_B + accel_bias + rng.normal(0.0, setting.imu * noise.accel_noise_density / np.sqrt(h), shape)
    buffer.add(ImuSample(0, tuple(w[0]), tuple(f[0])))
    for k in range(len(w)):
        buffer.add(ImuSample(round((k + 1) * h * 1e9), tuple(w[k]), tuple(f[k])))
    return buffer, gyro_bias, accel_bias


def bounds(draws: int, dimension: int, probability: float = 0.99) -> tuple[float, float]:
    """Between what the mean of so many NEES per dimension lies with a probability, if the filter is consistent."""
    n, tail = draws * dimension, 0.5 * (1.0 - probability)
    return float(chi2.ppf(tail, n)) / n, float(chi2.ppf(1.0 - tail, n)) / n


SETTINGS = {
    "as declared": Setting(), "calibration wrong as declared": Setting(calibration=True),
    "IMU noise 1.5 times the declared": Setting(imu=1.5), "IMU noise 1/1.5 of the declared": Setting(imu=1.0 / 1.5),
    "tracks 1.5 times as noisy as declared": Setting(pixels=1.5), "tracks 1/1.5 as noisy": Setting(pixels=1.0 / 1.5),
    "tracks with Student's t, 3 degrees of freedom": Setting(tail=3.0),
}


def mismatched(seed: int) -> Setting:
    """IMU's noise, tracks' noise and calibration errors between 1/1.5 and 1.5 times the declared."""
    imu, pixels, calibrated = 1.5 ** np.random.default_rng([seed, 1]).uniform(-1.0, 1.0, 3)
    return Setting(calibration=True, imu=imu, pixels=pixels, calibrated=calibrated)


def time_inside(draws: int, setting: Callable[[int], Setting], begin: float = 0.5) -> Iterator[str]:
    """Rows of a table: for all states and each part the mean NEES over draws and frames, and the share of the frames from `begin` [s] on
    at which the mean over the draws is within its 95 % bounds."""
    motions = ("circle", "hand", "eight", "far")
    flights = [list(frames(motions[seed % 4], seed, setting(seed))) for seed in range(draws)]
    for name, part in ({"15 states": slice(0, 15)} | PARTS).items():
        means = np.mean([[end.nees(part) for end in flight] for flight in flights], axis=0)[round(begin * Setting.frame_rate):]
        low, high = bounds(draws, part.stop - part.start, 0.95)
        yield f"| {name} | {means.mean():.2f} | {100 * np.mean((low < means) & (means < high)):.0f} % |"


def main() -> None:
    """Print the NEES of every setting, pooled over the motions."""
    parser = argparse.ArgumentParser(description="NEES of VIO's filter on exact tracks with declared noise")
    parser.add_argument("--draws", type=int, default=13, help="of each motion")
    parser.add_argument("--motions", default="circle,hand,eight,far")
    parser.add_argument("--settings", default=",".join(str(k) for k in range(len(SETTINGS))), help="by number")
    parser.add_argument("--time-inside", type=int, metavar="N", help="draws instead, as declared and under a mismatch")
    arguments = parser.parse_args()
    if arguments.time_inside:
        for name, choose in (("as declared", lambda _: Setting(calibration=True)), ("mismatched", mismatched)):
            print(f"| {name}, n = {arguments.time_inside} | NEES | time inside |\n| --- | --- | --- |", flush=True)
            print("\n".join(time_inside(arguments.time_inside, choose)), flush=True)
        return
    motions = arguments.motions.split(",")
    print(f"| setting | n | {' | '.join(PARTS)} | position [mm] |\n|{' --- |' * (len(PARTS) + 3)}")
    for number in map(int, arguments.settings.split(",")):
        name, setting = list(SETTINGS.items())[number]
        ends = [fly(m, seed, setting) for m in motions for seed in range(arguments.draws)]
        means = [np.mean([end.nees(part) for end in ends]) for part in PARTS.values()]
        rms = 1e3 * np.sqrt(np.mean([end.error[3:6] @ end.error[3:6] for end in ends]))
        print(f"| {name} | {len(ends)} | {' | '.join(f'{m:.2f}' for m in means)} | {rms:.1f} |", flush=True)
    low, high = bounds(arguments.draws * len(motions), 3)
    print(f"99 % of consistent filters: {low:.2f} to {high:.2f}")


if __name__ == "__main__":
    main()
