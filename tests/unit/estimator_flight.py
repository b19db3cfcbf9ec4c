"""An estimator fed with a perch, for its tests: exact motion, an IMU's readings, VIO poses that drift."""

import functools
from dataclasses import dataclass

import numpy as np
from perch_core import so3
from perch_core.vehicle import load_vehicle
from perch_eval import consistency
from open_loop.motion import PerchMotion, PerchMotionConfig, read_imu
from perch_perception.ukf import Estimator, ImuSample, UkfConfig, VioPose

DT = 0.002
IMU = load_vehicle("snapdragon").imu
MS = 1_000_000
WHITE = (0.002, 0.002)          # VIO's white noise of the tests [m, rad]: what `VioNoise` adds to a covariance
DRIFT = (0.010, 0.004)          # VIO's drift of the tests [m/sqrt(s), rad/sqrt(s)]


@functools.lru_cache(maxsize=None)
def motion_of(seed, distance=1.7):
    motion = PerchMotion(PerchMotionConfig(distance=distance), seed)
    return motion.sample(np.arange(0.0, motion.duration - 0.003, DT))


@dataclass
class Flight:
    """An estimator fed with a perch: readings, VIO poses that drift, and what came out."""

    seed: int = 0
    latency: float = 0.040
    config: UkfConfig = UkfConfig()
    drift: bool = True  # VIO's map walks away; else its errors are new in every pose

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        self.truth = motion_of(self.seed)
        self.readings = read_imu(self.truth, IMU, self.rng)
        self.q = self.truth.q_WB
        self.estimator = Estimator(self.config)
        self.poses = self.make_poses()

    def make_poses(self):
        n, h = len(self.truth.times), 17 * DT
        white = np.diag(np.repeat([WHITE[0] ** 2, WHITE[1] ** 2], 3))
        d, C = self.rng.normal(0, 1, 6) * np.repeat([0.002, 0.003], 3) * self.drift, np.diag(np.repeat([0.002**2, 0.003**2], 3)) * self.drift
        poses = {}
        for k in range(160, n, 17):
            W = np.diag(np.repeat([DRIFT[0] ** 2 * h, DRIFT[1] ** 2 * h], 3)) * self.drift
            d, C = d + self.rng.multivariate_normal(np.zeros(6), W), C + W
            e = d + self.rng.multivariate_normal(np.zeros(6), white)
            q = so3.quat_multiply(so3.quat_exp(e[3:]), self.q[k])
            poses[k] = VioPose(k * 2 * MS, self.truth.p_WB[k] + e[:3], q, C, so3.quat_to_matrix(q).T @ self.truth.v_WB[k])
        return poses

    def sample(self, k):
        return ImuSample(k * 2 * MS, tuple(self.readings.gyro[k]), tuple(self.readings.accel[k]))

    def step(self, k, imu=True):
        delay = round(self.latency / DT)
        if k - delay in self.poses:
            self.vio_outcome = self.estimator.add_vio(self.poses[k - delay])
        if imu:
            self.imu_outcome = self.estimator.add_imu(self.sample(k))

    def fly(self, start=0, end=None):
        for k in range(start, end or len(self.truth.times)):
            self.step(k)
        return self

    def error(self):
        e = self.estimator.estimate
        k = round(e.stamp / (2 * MS))
        r = self.readings
        return np.concatenate([self.truth.p_WB[k] - e.p_WB, self.truth.v_WB[k] - e.v_WB,
                               consistency.attitude_error(self.q[k], e.q_WB),
                               r.gyro_bias[k] - e.gyro_bias, r.accel_bias[k] - e.accel_bias])

    def assert_sane(self):
        e = self.estimator.estimate
        assert np.isfinite(np.concatenate([e.p_WB, e.v_WB, e.q_WB, e.w_WB_B, e.P.ravel()])).all()
        assert np.linalg.eigvalsh(e.P)[0] > 0
        assert abs(np.linalg.norm(e.q_WB) - 1) < 1e-9

    def sigma(self):
        return np.sqrt(np.diag(self.estimator.estimate.P))
