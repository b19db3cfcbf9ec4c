"""Settings of the estimator's UKF, with units and ranges (`config/estimator.yaml`)."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import derived, part, quantity, text


@dataclass(frozen=True)
class ImuNoise:
    """IMU noise and ranges for the filters: from the sensor file, by default those of an MPU-9250 (MEMS) on a vehicle in flight.

    Attributes:
        accel_noise_density, gyro_noise_density: vibration included, at any sample rate [m/s^2/sqrt(Hz), rad/s/sqrt(Hz)].
        accel_bias_walk, gyro_bias_walk: [m/s^2/sqrt(s), rad/s/sqrt(s)].
        accel_bias_init, gyro_bias_init: 1 sigma of the turn-on biases; data sheets state up to 5 deg/s [m/s^2, rad/s].
        accel_range, gyro_range: saturation of one axis [m/s^2, rad/s].
        integration: `mean`: a sample is the mean over the period that ends at its stamp (IMUs with an averaging filter);
            `instant`: samples are instantaneous, and a step uses the mean of its two ends.
    """

    accel_noise_density: float = 0.015
    gyro_noise_density: float = 0.0005
    accel_bias_walk: float = 0.002
    gyro_bias_walk: float = 0.0002
    accel_bias_init: float = 0.05
    gyro_bias_init: float = 0.1
    accel_range: float = 156.0
    gyro_range: float = 34.0
    integration: str = "mean"


@dataclass(frozen=True)
class VioNoise:
    """Noise added to the pose covariance of each measurement, because some publishers leave the covariance at zero."""

    position: float = quantity(0.002, unit="m", above=0.0, doc="1 sigma of each axis")
    attitude: float = quantity(0.002, unit="rad", above=0.0, doc="1 sigma about each axis")


@dataclass(frozen=True)
class UkfConfig:
    """Settings of the estimator's UKF."""

    sensors: str = text("", doc="sensor file, config/sensors/<name>.yaml or a path: noise and axes of the IMU; empty: noise of an MPU-9250")
    imu: ImuNoise = derived(ImuNoise())
    vio: VioNoise = part(VioNoise)
    coasting_after: float = quantity(0.15, unit="s", above=0.0, doc="age of the last accepted VIO pose beyond which the state is COASTING")
