"""Contents of the sensor file: noise of the IMU, cameras and the accuracy of their calibration."""

from __future__ import annotations

from perch_core import config
from perch_core.camera_mount import CameraMount
from perch_core.errors import ConfigError
from perch_core.sensors import CalibrationSigmas, load_sensors
from perch_perception.ukf.config import ImuNoise


def sensors_parameter() -> str:
    """Declares the parameter `sensors`."""
    return config.text("", doc=(
        "sensor file, config/sensors/<name>.yaml or a path: noise and axes of the IMU; its cameras and how well they are calibrated, in place of "
        "the vehicle file's and of camera_info; empty: none"))


def camera_mounts(sensors: str) -> dict[str, CameraMount]:
    """Return the cameras of the sensor file; empty where no file is named or it describes none.

    Raises:
        ConfigError: no such file, or a value that is refused.
    """
    return load_sensors(sensors).mounts if sensors else {}


def imu_noise(sensors: str, given: ImuNoise) -> ImuNoise:
    """Return the IMU noise of the sensor file; `given` where no file is named.

    Raises:
        ConfigError: no such file, or it has no IMU.
    """
    if not sensors:
        return given
    imu = load_sensors(sensors).imu
    if imu is None:
        raise ConfigError(sensors, "imu", "missing")
    return ImuNoise(imu.accel_noise_density, imu.gyro_noise_density, imu.accel_bias_walk, imu.gyro_bias_walk, imu.accel_bias, imu.gyro_bias,
                    imu.accel_range, imu.gyro_range, imu.integration)


def calibration_sigmas(sensors: str, camera: str, given: CalibrationSigmas) -> CalibrationSigmas:
    """Return the calibration uncertainty of a camera of the sensor file; `given` where no file is named or it lacks the camera.

    Whether the camera exists is checked by the component that uses it.
    """
    cameras = load_sensors(sensors).cameras if sensors else {}
    return cameras[camera].sigma if camera in cameras else given
