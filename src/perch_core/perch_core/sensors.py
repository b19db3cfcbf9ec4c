"""Sensors of a vehicle: cameras and IMU, as described by data sheets and calibration reports.

Each set of sensors is one YAML file in `config/sensors/`. Nodes read it (parameter `sensors`), and so does `scripts/perceive.py`
for recordings; `scripts/sensors.py import` converts a Kalibr or EuRoC calibration. The simulator does not use it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from perch_core import config, so3
from perch_core.arrays import Quaternion, Vector3
from perch_core.camera import IMAGE_SIZE_MIN, Camera, camera_of
from perch_core.camera_mount import CameraMount
from perch_core.config import choice, label, part, quantity, text
from perch_core.errors import ConfigError


@dataclass(frozen=True)
class CalibrationSigmas:
    """Uncertainty of a camera's calibration (0: known exactly) and of points tracked in its images, 1 sigma.

    The defaults suit a careful Kalibr calibration and a global shutter.
    """

    rotation: float = quantity(0.005, unit="rad", low=0.0, high=0.2, doc="camera against IMU, per axis")
    translation: float = quantity(0.002, unit="m", low=0.0, high=0.2, doc="camera against IMU, per axis")
    time_offset: float = quantity(0.002, unit="s", low=0.0, high=0.1, doc="camera against the IMU's clock")
    focal: float = quantity(0.003, unit="-", low=0.0, high=0.05, doc="relative error of each focal length")
    centre: float = quantity(0.5, unit="px", low=0.0, high=50.0, doc="principal point, per axis")
    track: float = quantity(0.085, unit="px", above=0.0, high=10.0, doc="white noise of a tracked point; about 1 with a rolling shutter")

    @property
    def lens(self) -> np.ndarray:
        """1 sigma of fx, fy (relative), cx, cy [px], shape (4,)."""
        return np.array([self.focal, self.focal, self.centre, self.centre])


@dataclass(frozen=True, kw_only=True)
class CameraSensor:
    """A camera as its calibration describes it."""

    model: str = choice(options=("radtan", "equidistant", "pinhole"), doc="projection, in Kalibr's words")
    width: int = quantity(unit="px", low=IMAGE_SIZE_MIN, high=1 << 14)
    height: int = quantity(unit="px", low=IMAGE_SIZE_MIN, high=1 << 14)
    focal: tuple[float, float] = quantity(unit="px", above=0.0, high=1e5, doc="fx, fy")
    centre: tuple[float, float] = quantity(unit="px", low=-1e4, high=2e4, doc="cx, cy")
    distortion: tuple[float, ...] = quantity((), low=-100.0, high=100.0, doc=(
        "radtan: k1, k2, p1, p2, then k3, then k4, k5, k6, as many as there are; equidistant: k1..k4; pinhole: none"))
    position: Vector3 = quantity((0.0, 0.0, 0.0), unit="m", low=-5.0, high=5.0, doc="p_BC")
    orientation: Quaternion = quantity((0.0, 0.0, 0.0, 1.0), low=-1.01, high=1.01, doc="q_BC, xyzw")
    rate: float = quantity(30.0, unit="Hz", above=0.0, high=500.0)
    stamp_offset: float = quantity(0.0, unit="s", low=-0.5, high=0.5, doc=(
        "stamp of an image minus the middle of its exposure on the IMU's clock: minus Kalibr's timeshift_cam_imu"))
    colour: bool = quantity(False, doc="delivers colour")
    topic: str = text("", doc="of its images in recordings; empty: camera_<name>/image_raw")
    sigma: CalibrationSigmas = part(CalibrationSigmas)

    def __post_init__(self) -> None:
        check_quaternion("orientation", self.orientation)
        if self.model == "pinhole" and any(self.distortion):
            raise ConfigError("", "distortion", f"{list(self.distortion)} of a pinhole: the model with distortion is radtan")
        self.camera  # noqa: B018 (raises where it is none)

    @cached_property
    def camera(self) -> Camera:
        """The projection."""
        fx, fy, cx, cy = *self.focal, *self.centre
        name = {"equidistant": "equidistant", "pinhole": ""}.get(self.model)
        if name is None:
            name = "plumb_bob" if len(self.distortion) <= 5 else "rational_polynomial"
        try:
            return camera_of(name, self.width, self.height, np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
                             np.array(self.distortion if self.model != "pinhole" else ()))
        except ConfigError as error:
            raise ConfigError("", "focal" if error.key == "k" else "distortion", error.problem) from None

    def mount(self, name: str) -> CameraMount:
        """Return the camera with its pose on the body."""
        return CameraMount(name=name, camera=self.camera, p_BC=np.array(self.position), R_BC=_rotation(self.orientation), rate=self.rate,
                           stamp_offset=self.stamp_offset, colour=self.colour)


@dataclass(frozen=True, kw_only=True)
class ImuSensor:
    """An IMU as described by its data sheet or an Allan deviation; the noise includes vibration in flight."""

    rate: float = quantity(unit="Hz", low=10.0, high=4000.0)
    accel_noise_density: float = quantity(unit="m/s^2/sqrt(Hz)", above=0.0, high=10.0)
    gyro_noise_density: float = quantity(unit="rad/s/sqrt(Hz)", above=0.0, high=1.0)
    accel_bias_walk: float = quantity(unit="m/s^2/sqrt(s)", above=0.0, high=10.0)
    gyro_bias_walk: float = quantity(unit="rad/s/sqrt(s)", above=0.0, high=1.0)
    accel_bias: float = quantity(0.2, unit="m/s^2", above=0.0, high=10.0, doc="1 sigma of the turn-on bias")
    gyro_bias: float = quantity(0.1, unit="rad/s", above=0.0, high=1.0, doc="1 sigma of the turn-on bias")
    accel_range: float = quantity(156.0, unit="m/s^2", above=0.0, high=1e4, doc="saturation of an axis")
    gyro_range: float = quantity(34.0, unit="rad/s", above=0.0, high=1e3, doc="saturation of an axis")
    integration: str = choice("instant", options=("mean", "instant"), doc=(
        "mean: a sample is the mean over the period that ends at its stamp; instant: it is the value at its stamp"))
    orientation: Quaternion = quantity((0.0, 0.0, 0.0, 1.0), low=-1.01, high=1.01, doc="q_BI, xyzw: its axes in B, whose origin it is")
    topic: str = text("", doc="of its samples in recordings; empty: imu/data_raw")

    def __post_init__(self) -> None:
        check_quaternion("orientation", self.orientation)

    @property
    def accel_noise(self) -> float:
        """1 sigma of one sample [m/s^2]."""
        return self.accel_noise_density * float(self.rate**0.5)

    @property
    def gyro_noise(self) -> float:
        """1 sigma of one sample [rad/s]."""
        return self.gyro_noise_density * float(self.rate**0.5)

    @cached_property
    def R_BI(self) -> np.ndarray:
        """Axes of the IMU in B, shape (3, 3)."""
        return _rotation(self.orientation)


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Cameras by name, and the IMU; each is optional. The origin of B is in the IMU."""

    name: str = label()
    cameras: dict[str, CameraSensor] = part(dict)
    imu: ImuSensor | None = text(None)

    @cached_property
    def mounts(self) -> dict[str, CameraMount]:
        """The cameras with their poses on the body, by name."""
        return {name: camera.mount(name) for name, camera in self.cameras.items()}


def load_sensors(name_or_path: str | Path) -> Sensors:
    """Return the sensors of `config/sensors/<name>.yaml`, or of a file.

    Raises:
        ConfigError: no such file, or a value that is refused.
    """
    file = config.find("sensors", name_or_path)
    sensors = config.load(Sensors, file)
    check_camera_names(sensors.cameras, str(file))
    return sensors


def _rotation(q: Quaternion) -> np.ndarray:
    return so3.quat_to_matrix(np.array(q) / np.linalg.norm(q))


def check_camera_names(names: Iterable[str], source: str = "") -> None:
    """Refuse names of cameras of which no topic `camera_<name>/...` can be made.

    Raises:
        ConfigError: a name has other characters than letters, digits and underscores.
    """
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_]+", name):
            raise ConfigError(source, "cameras", f"{name!r} is no name of a camera: its topics are camera_<name>/..., of letters, digits and underscores")


def check_quaternion(key: str, q: Quaternion) -> None:
    """Refuse a quaternion whose norm is not 1.

    Raises:
        ConfigError: the norm is not 1; the error names the key.
    """
    if not abs(np.linalg.norm(q) - 1.0) < 1e-3:
        raise ConfigError("", key, f"norm {np.linalg.norm(q):.4f} is not 1")
