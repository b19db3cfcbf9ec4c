"""VIO and estimator on a true perch motion with rendered images, without controller, graph or ROS.

For benches, tests and Monte-Carlo runs of consistency: the images, the camera's calibration errors and the IMU are the
simulator's, the motion is exact (`perch_motion`), and nothing of the truth reaches the estimators.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from perch_core import so3
from perch_core.camera import CameraMount
from perch_core.processes import frozen_heap
from perch_core.scenario import Scenario
from perch_core.timing import CONTROL_PERIOD
from perch_core.vehicle import load_vehicle
from perch_eval.consistency import attitude_error
from perch_eval.perch_motion import ImuReadings, Motion, PerchMotion, PerchMotionConfig, read_imu
from perch_perception.ukf import Estimator, ImuSample, Inertial, UkfConfig, VioPose
from perch_perception.ukf.odometry import vio_state
from perch_perception.vio import VioConfig, VioPoseEstimate, VioResult, VisualInertialOdometry
from perch_sim.calibration import true_mount
from perch_sim.rendering import Renderer, build_scene

DURATIONS = {1.7: 1.8, 3.0: 2.0}  # of the perch by distance: 570-700 deg/s at 90 deg [m -> s]


@dataclass(frozen=True)
class Flight:
    """A perch as the sensors saw it.

    Attributes:
        motion: the true motion, at any time.
        truth: the true motion at the IMU's stamps.
        readings: of the IMU.
        mount: the camera as calibrated, what VIO is told.
        frames: (middle of the exposure [s], stamp [ns], image), in order.
        told_wrong: by how much position [m] and yaw [rad] are wrong that VIO is told at its start, shape (4,).
    """

    motion: PerchMotion
    truth: Motion
    readings: ImuReadings
    mount: CameraMount
    frames: tuple[tuple[float, int, np.ndarray], ...]
    told_wrong: np.ndarray = field(default_factory=lambda: np.zeros(4))

    def sample(self, k: int) -> ImuSample:
        """IMU sample k."""
        return ImuSample(round(self.truth.times[k] * 1e9), tuple(self.readings.gyro[k].tolist()),
                         tuple(self.readings.accel[k].tolist()))


def motion_of(scenario: Scenario, seed: int) -> PerchMotion:
    """A motion that ends on the scenario's pad."""
    vehicle, target = load_vehicle(scenario.vehicle), scenario.target
    angle = np.radians(target.inclination_deg)
    end = np.array([target.distance, 0.0, target.height]) + vehicle.perch_offset * np.array([-np.sin(angle), 0.0, np.cos(angle)])
    settings = PerchMotionConfig(
        ground_height=vehicle.perch_offset, height=scenario.mission.takeoff_height, distance=float(end[0]),
        rise=float(end[2] - scenario.mission.takeoff_height), inclination_deg=target.inclination_deg,
        perch=DURATIONS.get(target.distance, 2.0))
    return PerchMotion(settings, seed)


def fly(scenario: Scenario, seed: int, until: float = np.inf) -> Flight:
    """Sensor data of a perch; calibration errors are drawn where the scenario's realism asks for them.

    Args:
        scenario: room, pad and realism; its target must lie straight ahead of the start.
        seed: of everything.
        until: the flight is cut off there [s].
    """
    vehicle = load_vehicle(scenario.vehicle)
    mount, rng = vehicle.mounts["down"], np.random.default_rng([seed, 7])
    real = mount if scenario.realism == "ideal" else true_mount(mount, rng)
    motion = motion_of(scenario, seed)
    end = min(motion.duration, until)
    truth = motion.sample(np.arange(0.0, end - 1.5 * CONTROL_PERIOD, CONTROL_PERIOD))
    renderer = Renderer(build_scene(scenario, seed), real, seed)
    frames = []
    for middle in np.arange(0.02 + rng.uniform(0, 1 / mount.rate), end - 0.02, 1 / mount.rate):
        poses = motion.sample(middle + np.linspace(-0.5, 0.5, 5) * renderer.exposure.time)
        image = renderer.render(list(zip(poses.p_WB, poses.R_WB)), np.random.default_rng([seed, round(middle * 1e6)]))
        frames.append((float(middle), round((middle + real.stamp_offset) * 1e9), image))
    return Flight(motion, truth, read_imu(truth, vehicle.imu, rng), mount, tuple(frames), _told_wrong(seed))


def _told_wrong(seed: int) -> np.ndarray:
    """A start is told as well as VIO believes it: a covariance cannot be judged on an error that was never made."""
    s = VioConfig().start
    return np.random.default_rng([seed, 9]).standard_normal(4) * [*[s.position_sigma] * 3, s.yaw_sigma]


@dataclass(frozen=True)
class VioStep:
    """One frame's result with its truth.

    Attributes:
        time: middle of the exposure [s].
        result: what VIO said.
        cost: CPU time of the frame [s].
        error: truth minus estimate of (position, rotation about W's axes, velocity in B), shape (9,); None without a pose.
    """

    time: float
    result: VioResult
    cost: float
    error: np.ndarray | None


def run_vio(flight: Flight, config: VioConfig = VioConfig(),
            tamper: Callable[[float, int, np.ndarray], list[tuple[int, np.ndarray]]] | None = None,
            tamper_imu: Callable[[float, ImuSample], ImuSample | None] | None = None, begin: float = 0.0) -> list[VioStep]:
    """VIO over a flight.

    Args:
        flight: its data.
        config: VIO's settings.
        tamper: turns a frame (time, stamp, image) into those that arrive: none, others, several.
        tamper_imu: turns an IMU sample into the one that arrives, or None.
        begin: VIO is switched on there [s], and told the pose of that moment, as wrong as the flight has it.
    """
    start = flight.motion.sample(np.array([begin]))
    vio = VisualInertialOdometry(config, flight.mount, start.p_WB[0] + flight.told_wrong[:3], float(flight.told_wrong[3]))
    steps, k = [], int(np.searchsorted(flight.truth.times, begin))
    with frozen_heap():  # as nodes do
        for time_, stamp, image in flight.frames:
            if time_ < begin:
                continue
            while k < len(flight.truth.times) and flight.truth.times[k] < time_ + 0.02:
                sample = flight.sample(k)
                if tamper_imu is not None:
                    sample = tamper_imu(float(flight.truth.times[k]), sample)
                if sample is not None:
                    vio.add_imu(sample)
                k += 1
            for arriving, pixels in (tamper(time_, stamp, image) if tamper else [(stamp, image)]):
                clock = time.process_time()
                result = vio.add_image(arriving, pixels)
                cost = time.process_time() - clock
                steps.append(VioStep(time_, result, cost, _vio_error(flight, result)))
    return steps


def _vio_error(flight: Flight, result: VioResult) -> np.ndarray | None:
    e = result.estimate
    if e is None or e.stamp * 1e-9 > flight.motion.duration:
        return None
    m = flight.motion.sample(np.array([e.stamp * 1e-9]))
    return np.concatenate([m.p_WB[0] - e.p_WB, so3.log(m.R_WB[0] @ e.R_WB.T),
                           m.R_WB[0].T @ m.v_WB[0] - e.R_WB.T @ e.v_WB])


def received(e: VioPoseEstimate) -> VioPose:
    """What the estimator node makes of VIO's state."""
    return vio_state(e.stamp, e.p_WB, so3.quat_from_matrix(e.R_WB), e.v_WB, Inertial(e.gyro_bias, e.accel_bias, e.P))


@dataclass(frozen=True)
class EstimatorTrack:
    """The estimator along a flight, at n IMU stamps.

    Attributes:
        times: [s], shape (n,).
        errors: truth minus estimate of (p, v, theta, b_g, b_a), shape (n, 15).
        covariances: shape (n, 15, 15).
        nis: of each VIO pose.
    """

    times: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    nis: np.ndarray


def run_estimator(flight: Flight, steps: list[VioStep], config: UkfConfig = UkfConfig(), latency: float = 0.040,
                  begin: float = 0.7, stride: int = 5) -> EstimatorTrack:
    """The estimator on a flight's IMU and on VIO's poses, which arrive `latency` [s] after their exposure."""
    estimator, q, rows, nis = Estimator(config), flight.truth.q_WB, [], []
    poses: Iterator[VioPose] = iter([received(s.result.estimate) for s in steps if s.result.estimate is not None])
    pending = next(poses, None)
    for k, t in enumerate(flight.truth.times):
        while pending is not None and pending.stamp * 1e-9 + latency <= t:
            if estimator.add_vio(pending).used:
                nis.append(estimator.status.nis)
            pending = next(poses, None)
        estimator.add_imu(flight.sample(k))
        if t >= begin and k % stride == 0:
            e = estimator.estimate
            rows.append((t, np.concatenate([
                flight.truth.p_WB[k] - e.p_WB, flight.truth.v_WB[k] - e.v_WB, attitude_error(q[k], e.q_WB),
                flight.readings.gyro_bias[k] - e.gyro_bias, flight.readings.accel_bias[k] - e.accel_bias]), e.P))
    return EstimatorTrack(np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), np.array([r[2] for r in rows]),
                          np.array(nis))


def with_settings(config: VioConfig, **changes: dict) -> VioConfig:
    """A VIO configuration with changed parts: `with_settings(VioConfig(), filter={"landmarks": 10})`."""
    return replace(config, **{part: replace(getattr(config, part), **values) for part, values in changes.items()})
