"""VIO and estimator components on the flight loop, with a prescribed motion and rendered images, without a controller.

For benchmarks and tests. Images, camera calibration errors and IMU are the simulator's, the motion is exact
(`open_loop.motion`). Of the truth, the estimators are given only a perturbed start pose.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from closed_loop.plant import NoParameters
from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.component import Component, Input, Output
from perch_core.processes import without_collector
from perch_core.urdf import optical_frame
from perch_core.values import CameraImage, CameraModel, EstimatorHealth, ImuSample, InertialState
from perch_core.vehicle import load_vehicle
from perch_eval.consistency import attitude_error
from perch_eval.in_process import Loop
from open_loop.motion import ImuReadings, Motion, PerchMotion, PerchMotionConfig, read_imu
from perch_perception.estimator_component import StateEstimator
from perch_perception.ukf import Estimate, UkfConfig
from perch_perception.vio import VioResult
from perch_perception.vio.start import CONFIGURED_POSE_SIGMA
from perch_perception.vio_component import VioComponent, VioComponentConfig
from perch_sim.calibration import true_imu, true_mount
from perch_sim.lockstep import Task
from perch_sim.lockstep.batches import Arrival
from perch_sim.rendering import Renderer, Scene, build_scene
from perch_sim.scenario import Scenario
from perch_sim.timing import CONTROL_PERIOD

STRIDE = 5        # samples between states of the estimator that are kept
TRANSPORT = 0.02  # from the middle of an exposure to the arrival of its image [s]
DURATIONS = {1.7: 1.8, 3.0: 2.0}  # of the perch by distance: 570-700 deg/s at 90 deg [m -> s]


class TrueMotion(Protocol):
    """A motion whose state is known at any time in [0, duration] [s]."""

    @property
    def duration(self) -> float:
        """Total duration [s]."""

    def sample(self, times: np.ndarray) -> Motion:
        """Return the states at times [s], shape (n,)."""


@dataclass(frozen=True)
class Flight:
    """Sensor data of a motion, with the truth.

    Attributes:
        motion: the true motion, at any time.
        truth: the true motion at the IMU's stamps.
        readings: of the IMU.
        mount: the camera as calibrated, which VIO is given.
        frames: (middle of the exposure [s], stamp [ns], image), in order.
        start_error: error of the start position [m] and yaw [rad] that VIO is given, shape (4,).
        vehicle: name of the vehicle file.
    """

    motion: TrueMotion
    truth: Motion
    readings: ImuReadings
    mount: CameraMount
    frames: tuple[tuple[float, int, np.ndarray], ...]
    start_error: np.ndarray = field(default_factory=lambda: np.zeros(4))
    vehicle: str = "snapdragon"

    def sample(self, k: int) -> ImuSample:
        """IMU sample k."""
        return ImuSample(round(self.truth.times[k] * 1e9), tuple(self.readings.gyro[k].tolist()),
                         tuple(self.readings.accel[k].tolist()))


def motion_of(scenario: Scenario, seed: int) -> PerchMotion:
    """Return a perch motion that ends on the scenario's pad."""
    vehicle, target, surface = load_vehicle(scenario.vehicle), scenario.target, scenario.surface
    end = surface.p_WS + vehicle.perch_offset * surface.normal
    settings = PerchMotionConfig(
        ground_height=vehicle.perch_offset, height=scenario.mission.takeoff_height, distance=float(end[0]),
        rise=float(end[2] - scenario.mission.takeoff_height), inclination_deg=target.inclination_deg,
        perch=DURATIONS.get(target.distance, 2.0))
    return PerchMotion(settings, seed)


def fly(scenario: Scenario, seed: int) -> Flight:
    """Return sensor data of a perch; calibration errors of the camera are drawn unless the scenario's realism is `ideal`.

    Args:
        scenario: room, pad and realism; its target must lie straight ahead of the start.
        seed: of every random number.
    """
    return sensor_data(motion_of(scenario, seed), build_scene(scenario, seed), scenario, seed)


def sensor_data(motion: TrueMotion, scene: Scene, scenario: Scenario, seed: int) -> Flight:
    """Return sensor data of a motion in a scene, as `fly`; only vehicle and realism of the scenario are used."""
    vehicle = load_vehicle(scenario.vehicle)
    mount, rng = vehicle.mounts["down"], np.random.default_rng([seed, 7])
    real = mount if scenario.realism == "ideal" else true_mount(mount, rng)
    truth = motion.sample(np.arange(0.0, motion.duration - 1.5 * CONTROL_PERIOD, CONTROL_PERIOD))
    renderer = Renderer(scene, real, seed)
    frames = []
    for middle in np.arange(0.02 + rng.uniform(0, 1 / mount.rate), motion.duration - 0.02, 1 / mount.rate):
        poses = motion.sample(middle + np.linspace(-0.5, 0.5, 5) * renderer.exposure.time)
        image = renderer.render(list(zip(poses.p_WB, poses.R_WB)), np.random.default_rng([seed, round(middle * 1e6)]))
        frames.append((float(middle), round((middle + real.stamp_offset) * 1e9), image))
    # The start pose is as accurate as its covariance states: a covariance cannot be judged on an error that was never made.
    start_error = np.random.default_rng([seed, 9]).standard_normal(4) * CONFIGURED_POSE_SIGMA
    return Flight(motion, truth, read_imu(truth, true_imu(vehicle.imu, seed), rng), mount, tuple(frames), start_error, scenario.vehicle)


@dataclass(frozen=True)
class VioStep:
    """One frame's result with its truth.

    Attributes:
        time: middle of the exposure [s].
        result: of VIO.
        cost: CPU time of the frame [s].
        error: truth minus estimate of (position, rotation about W's axes, velocity in B), shape (9,); None without a pose.
    """

    time: float
    result: VioResult
    cost: float
    error: np.ndarray | None


class _Frame(CameraImage):
    """An image with the middle of its exposure [s]."""

    __slots__ = ("middle",)
    middle: float


class _Vehicle(Component[NoParameters]):
    """Replays the sensor data of a flight in place of a loop's vehicle."""

    config_type = NoParameters

    imu = Output(ImuSample, "imu/data_raw")
    camera_info = Output(CameraModel, "camera_down/camera_info")
    image = Output(CameraImage, "camera_down/image_raw")

    def __init__(self, flight: Flight, begin: float = 0.0, transport: float = TRANSPORT) -> None:
        super().__init__(NoParameters())
        self._flight, self._transport = flight, transport
        self._k = int(np.searchsorted(flight.truth.times, begin))
        self._frames = deque(frame for frame in flight.frames if frame[0] >= begin)
        self.time = 0

    @property
    def over(self) -> bool:
        """Whether there are no more samples."""
        return self._k >= len(self._flight.truth.times)

    def advance(self) -> list[Arrival]:
        """Emit the next IMU sample and the frames due by then; return these frames' arrivals."""
        at = float(self._flight.truth.times[self._k])
        sample = self._flight.sample(self._k)
        self._k, self.time = self._k + 1, sample.stamp
        self.imu(sample)
        arrivals = []
        while self._frames and self._frames[0][0] + self._transport <= at:
            arrivals.append(self._emit_frame(*self._frames.popleft()))
        return arrivals

    def _emit_frame(self, middle: float, stamp: int, pixels: np.ndarray) -> Arrival:
        frame = optical_frame("down")
        image = _Frame(stamp, frame, pixels.shape[1], pixels.shape[0], "mono8", pixels)
        image.middle = middle
        self.camera_info(CameraModel(stamp, frame, self._flight.mount.camera))
        self.image(image)
        return Arrival("down", stamp, round(middle * 1e9), image)


class _Vio(VioComponent):
    """VIO component that records result and processor time of each frame."""

    def __init__(self, config: VioComponentConfig) -> None:
        super().__init__(config)
        self.frames: list[tuple[float, VioResult, float]] = []  # middle of the exposure [s], result, CPU time [s]

    def use(self, image: CameraImage) -> None:
        """Process an image as the base class does; record result and processor time."""
        assert isinstance(image, _Frame)
        clock = time.process_time()
        super().use(image)
        assert self.result is not None
        self.frames.append((image.middle, self.result, time.process_time() - clock))


class _ReplayedVio(Component[NoParameters]):
    """Replays VIO's states, each when its frame arrives."""

    config_type = NoParameters

    frame = Input(CameraModel, "camera_down/camera_info")
    state = Output(InertialState, "vio/state")

    def __init__(self, states: dict[int, InertialState]) -> None:
        super().__init__(NoParameters())
        self._states = states

    def on_frame(self, model: CameraModel) -> None:
        """Emit the state of the frame with this stamp, if there is one."""
        if model.stamp in self._states:
            self.state(self._states[model.stamp])


class _Estimator(StateEstimator):
    """Estimator that records its state at every `STRIDE`-th sample from `begin` [s] on."""

    def __init__(self, begin: float) -> None:
        super().__init__(UkfConfig())  # type: ignore[arg-type]  # the name of the estimator is nothing to itself
        self._from, self._samples = round(begin * 1e9), 0
        self.states: list[tuple[int, Estimate]] = []  # number of the sample

    def on_imu(self, sample: ImuSample) -> None:
        """Process a sample as the base class does; record the state."""
        super().on_imu(sample)
        if sample.stamp >= self._from and self._samples % STRIDE == 0:
            assert self.filter.estimate is not None
            self.states.append((self._samples, self.filter.estimate))
        self._samples += 1


def run_vio(flight: Flight, begin: float = 0.0, level_ground: bool = True) -> list[VioStep]:
    """Run VIO over a flight, from `begin` [s] on. Its start pose is the true position at yaw 0, both with the error `start_error`.

    Args:
        flight: the sensor data.
        begin: start of VIO [s].
        level_ground: whether the vehicle stands on level ground at the start.
    """
    standing = flight.motion.sample(np.array([begin])).p_WB[0] - (0.0, 0.0, load_vehicle(flight.vehicle).standing_height)
    vio = _Vio(VioComponentConfig(
        vehicle=flight.vehicle, level_ground=level_ground,
        start_position=tuple((standing + flight.start_error[:3]).tolist()), start_yaw_deg=float(np.degrees(flight.start_error[3]))))
    vehicle = _Vehicle(flight, begin)
    _run(Loop(vehicle, {"vio": vio}, {"vio": Task(0.0)}, {}), vehicle)
    return [VioStep(middle, result, cost, _vio_error(flight, result)) for middle, result, cost in vio.frames]


def _run(loop: Loop, vehicle: _Vehicle) -> None:
    with without_collector():  # a trace only grows
        while not vehicle.over:
            loop.step()


def _vio_error(flight: Flight, result: VioResult) -> np.ndarray | None:
    e = result.estimate
    if e is None or e.stamp * 1e-9 > flight.motion.duration:
        return None
    m = flight.motion.sample(np.array([e.stamp * 1e-9]))
    return np.concatenate([m.p_WB[0] - e.p_WB, so3.log(m.R_WB[0] @ e.R_WB.T),
                           m.R_WB[0].T @ m.v_WB[0] - e.R_WB.T @ e.v_WB])


@dataclass(frozen=True)
class EstimatorTrack:
    """Errors and covariances of the estimator along a flight, at n IMU stamps.

    Attributes:
        times: [s], shape (n,).
        errors: truth minus estimate of (p, v, theta, b_g, b_a), shape (n, 15).
        covariances: shape (n, 15, 15).
        health: the estimator's health messages, ten per second.
    """

    times: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray
    health: tuple[EstimatorHealth, ...] = ()


def run_estimator(flight: Flight, steps: list[VioStep], latency: float = 0.040, begin: float = 0.7) -> EstimatorTrack:
    """Run the estimator on IMU samples and VIO states, each used `latency` [s] after its exposure, or with the next sample."""
    stamps = {middle: stamp for middle, stamp, _ in flight.frames}
    states = {stamps[s.time]: InertialState(e.stamp, e.p_WB, so3.quat_from_matrix(e.R_WB), e.v_WB, e.gyro_bias, e.accel_bias, e.P)
              for s in steps if (e := s.result.estimate) is not None and s.time in stamps}
    estimator, vehicle = _Estimator(begin), _Vehicle(flight, transport=min(TRANSPORT, latency))
    loop = Loop(vehicle, {"estimator": estimator, "vio": _ReplayedVio(states)}, {"estimator": Task(), "vio": Task(latency)}, {})
    _run(loop, vehicle)
    truth, readings, q = flight.truth, flight.readings, flight.truth.q_WB
    errors = [np.concatenate([truth.p_WB[k] - e.p_WB, truth.v_WB[k] - e.v_WB, attitude_error(q[k], e.q_WB),
                              readings.gyro_bias[k] - e.gyro_bias, readings.accel_bias[k] - e.accel_bias]) for k, e in estimator.states]
    return EstimatorTrack(np.array([truth.times[k] for k, _ in estimator.states]), np.array(errors),
                          np.array([e.P for _, e in estimator.states]), tuple(loop.trace.values("estimator/status")))
