"""Visual-inertial odometry: images of the downward camera and IMU samples in, full state and odometry per frame out. [M:IV-B]"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perch_core import config, so3
from perch_core.camera_mount import CameraMount
from perch_core.component import Diagnostics, Input, Output
from perch_core.values import CameraImage, ImuSample, InertialState, OdometryState, RotorState, Transform, rotated
from perch_core.vehicle import load_vehicle
from perch_perception.camera_component import CameraComponent, extrinsics_parameter, images_parameter
from perch_perception.images import ImageError, mono_image
from perch_perception.imu_intake import ImuIntake
from perch_perception.sensor_file import calibration_sigmas, imu_noise, sensors_parameter
from perch_perception.ukf.imu_buffer import ImuOutcome
from perch_perception.ukf.odometry import covariances
from perch_perception.vio import FrameOutcome, VioConfig, VioPoseEstimate, VioResult, VisualInertialOdometry
from perch_perception.vio.drawing import TrackPainter
from perch_perception.world_frames import ODOM, is_world

DIAGNOSTICS_PERIOD = 1_000_000_000  # [ns]


@dataclass(frozen=True)
class VioComponentConfig(VioConfig):
    """Parameters of the component: those of the odometry, vehicle and camera, and the pose at the start."""

    vehicle: str = config.text("snapdragon", doc="vehicle whose camera it is, config/vehicles/<name>.yaml")
    sensors: str = sensors_parameter()
    camera: str = config.text("down", doc="camera of the vehicle; its images are on camera_<name>/image_raw")
    images: str = images_parameter()
    extrinsics: str = extrinsics_parameter()
    start_position: tuple[float, float, float] = config.quantity(
        (0.0, 0.0, 0.0), unit="m", doc="ground point under the vehicle in map, as in a scenario's start")
    start_yaw_deg: float = config.quantity(0.0, unit="deg", low=-180.0, high=180.0, doc="heading at the start in map")
    level_ground: bool = config.quantity(True, doc="at the start it stands on level ground, of which start_position is a point")


class VioComponent(CameraComponent[VioComponentConfig]):
    """Publishes `state` and `odometry` for every frame that gives a pose, once the IMU has passed its exposure.

    Attributes:
        result: of the last frame; None before the first.
    """

    config_type = VioComponentConfig

    imu = Input(ImuSample, "imu/data_raw", lazy=True)
    estimate = Input(OdometryState, "odometry", lazy=True)
    rotors = Input(RotorState, "rotor_state", lazy=True)
    state = Output(InertialState, "vio/state")
    odometry = Output(OdometryState, "vio/odometry")
    debug_image = Output(CameraImage, "vio/debug_image")

    def __init__(self, config: VioComponentConfig) -> None:
        super().__init__(replace(config, imu=imu_noise(config.sensors, config.imu),
                                 calibration=calibration_sigmas(config.sensors, config.camera, config.calibration)))
        self._standing_height = load_vehicle(config.vehicle).standing_height
        self._intake = ImuIntake(self.warn, config.sensors)
        self._counts = dict.fromkeys(FrameOutcome, 0)
        self._painter = TrackPainter()
        self._begin()

    def _begin(self) -> None:
        """Reset the odometry to the configured start on the ground."""
        c = self.config
        standing = np.array(c.start_position) + [0.0, 0.0, self._standing_height]
        self._vio = VisualInertialOdometry(c, self.mounted.mount or self.mounted.nominal, standing, float(np.radians(c.start_yaw_deg)),
                                           float(c.start_position[2]) if c.level_ground else None)
        self.result: VioResult | None = None
        self._outcome: FrameOutcome | None = None
        self._diagnosed: int | None = None

    @property
    def missing(self) -> str:
        """Description of what all images wait for: the camera, or the first IMU sample."""
        return super().missing or ("" if self._vio.has_imu else f"no {self._channel('imu')} yet")

    def use_camera(self, mount: CameraMount) -> None:
        """Pass a changed camera to the odometry."""
        if mount is not self._vio.mount:
            self._vio.use_camera(mount)

    def on_transform(self, transform: Transform) -> None:
        """Take a static transform, which may be that of the camera's or the IMU's frame."""
        self._intake.axes.add_transform(transform)
        super().on_transform(transform)

    def on_imu(self, sample: ImuSample) -> None:
        """Take an IMU sample, and use the images that it covers."""
        taken = self._intake.take(sample)
        if taken is None:
            return
        if self._intake.restarted:
            elsewhere = self._vio.has_left_start_before(taken.stamp)
            self._begin()
            if elsewhere:
                self._vio.forget_start(taken.stamp)
                self.warn("imu/data_raw: stamps jumped ahead after the vehicle had left its start: position and heading are unknown", 0.0)
            self.clear_queue()
        self.note_time(taken.stamp)
        outcome = self._vio.add_imu(taken)
        if outcome is not ImuOutcome.USED:
            self.warn(f"imu/data_raw: sample at {sample.stamp} ns {outcome.value}", 1.0)
        if self._queue:
            self.advance()

    def on_estimate(self, odometry: OdometryState) -> None:
        """Take the estimator's odometry, whose pose a VIO that is started in flight continues."""
        if is_world(odometry.frame):
            self._vio.add_odometry(odometry)
        else:
            self.warn(f"odometry: frame {odometry.frame!r} is not a known fixed frame: ignored", 1.0)

    def on_rotors(self, rotors: RotorState) -> None:
        """Take the state of the rotors: where they stand, a vehicle with a quiet IMU rests."""
        self._vio.add_rotors(rotors)

    def is_ready(self, image: CameraImage) -> bool:
        """Whether the IMU has passed the image's exposure, or its stamp is too far ahead to wait for."""
        return self._vio.covers(image.stamp)

    def use(self, image: CameraImage) -> None:
        """Process a frame, and publish the result."""
        pixels: np.ndarray | None = None
        try:
            pixels = mono_image(image, self.mounted.known.camera)
            result = self._vio.add_image(image.stamp, pixels)
        except ImageError as error:
            result = VioResult(FrameOutcome.BAD_IMAGE, message=str(error))
        self.result = result
        self._counts[result.outcome] += 1
        if result.estimate is not None:
            self._emit(result.estimate)
        if result.outcome is not self._outcome:
            self._outcome = result.outcome
            (self.info if result.outcome.has_pose else self.warn)(f"{result.outcome.name.lower()}: {result.message}")
        if pixels is not None and self.debug_image.has_receivers:
            self._draw(image, pixels, result)
        if self._diagnosed is None or abs(image.stamp - self._diagnosed) >= DIAGNOSTICS_PERIOD:
            self._diagnosed = image.stamp
            self._diagnose(image.stamp, result)

    def _emit(self, e: VioPoseEstimate) -> None:
        q = so3.quat_from_matrix(e.R_WB)
        self.state(InertialState(e.stamp, e.p_WB, q, e.v_WB, e.gyro_bias, e.accel_bias, e.P, ODOM))
        q_WB = tuple(q.tolist())
        self.odometry(OdometryState(e.stamp, tuple(e.p_WB.tolist()), q_WB, rotated(q_WB, e.v_WB.tolist(), -1.0), tuple(e.w_WB_B.tolist()),
                                    *covariances(e.R_WB, e.v_WB, e.P, self._vio.gyro_sigma), ODOM))

    def _draw(self, image: CameraImage, pixels: np.ndarray, result: VioResult) -> None:
        features = self._vio.tracker.latest
        if features is None:
            return
        landmarks = set(self._vio.filter.state.landmarks) if self._vio.filter else set()
        caption = f"{result.outcome.name.lower()}  {result.features} tracks, {result.used} used, {result.refused} refused"
        drawn = self._painter.paint(pixels, features, landmarks, caption)
        self.debug_image(CameraImage(image.stamp, image.frame, drawn.shape[1], drawn.shape[0], "bgr8", drawn))

    def _diagnose(self, stamp: int, result: VioResult) -> None:
        values = {"outcome": result.outcome.name, "features": result.features, "used": result.used, "refused": result.refused,
                  "blind_for_s": float(result.blind_for), "restarts": result.restarts, "dropped": self.dropped,
                  "time_offset_ms": 1e3 * float(self._vio.time_offset)}
        values |= {f"frames_{outcome.name.lower()}": n for outcome, n in self._counts.items() if n}
        self.diagnostics(Diagnostics(stamp, values, 0 if result.outcome.has_pose else 1, result.message))
