"""Settings of the estimator's UKF, with units and ranges (`config/estimator.yaml`)."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import choice, part, quantity, text


@dataclass(frozen=True)
class ImuNoise:
    """What the filter assumes of the IMU: noise densities, bias walks, ranges. They hold at any sample rate."""

    accel_noise_density: float = quantity(0.015, unit="m/s^2/sqrt(Hz)", above=0.0, doc="vibration included")
    gyro_noise_density: float = quantity(0.0005, unit="rad/s/sqrt(Hz)", above=0.0, doc="vibration included")
    accel_bias_walk: float = quantity(0.002, unit="m/s^2/sqrt(s)", above=0.0)
    gyro_bias_walk: float = quantity(0.0002, unit="rad/s/sqrt(s)", above=0.0)
    accel_bias_init: float = quantity(0.05, unit="m/s^2", above=0.0, doc="1 sigma of the turn-on bias")
    gyro_bias_init: float = quantity(0.1, unit="rad/s", above=0.0, doc="1 sigma of the turn-on bias (data sheets: up to 5 deg/s)")
    accel_range: float = quantity(156.0, unit="m/s^2", above=0.0, doc="saturation of one axis")
    gyro_range: float = quantity(34.0, unit="rad/s", above=0.0, doc="saturation of one axis")
    integration: str = choice("mean", options=("mean", "instant"), doc=(
        "mean: a sample is the mean over the period that ends at its stamp, as IMUs with an averaging filter give it; "
        "instant: samples are instantaneous, a step takes the mean of its two ends"))


@dataclass(frozen=True)
class ImuFaults:
    """How unusable stretches of IMU data are bridged."""

    gap: float = quantity(3.0, unit="-", above=1.0, doc="longest step between samples that counts as complete, in periods of the IMU")
    saturation: float = quantity(1.0, unit="-", above=0.0, high=5.0, doc="1 sigma of a saturated sample, share of its range")


@dataclass(frozen=True)
class RestConfig:
    """How rest is recognised, and how still it is: on the ground, on a wall, on a wire, in any attitude.

    Before a filter knows the biases, readings as large as the largest turn-on biases of MEMS sensors are still rest.
    """

    window: float = quantity(0.2, unit="s", above=0.02, high=2.0, doc="IMU over which rest is judged")
    energy: float = quantity(1.8, unit="-", above=1.0, high=20.0, doc="largest energy of the IMU about rest, in that of its noise: 1 is rest")
    velocity: float = quantity(0.002, unit="m/s", above=0.0, doc="1 sigma of the velocity at rest")
    gyro_bias: float = quantity(0.35, unit="rad/s", above=0.0, doc="largest turn-on bias (data sheets: 20 deg/s)")
    accel_bias: float = quantity(1.5, unit="m/s^2", above=0.0, doc="largest turn-on bias (data sheets: 150 mg)")


@dataclass(frozen=True)
class VioNoise:
    """What is added to the covariance that comes with each measurement: some senders leave it at zero."""

    position: float = quantity(0.002, unit="m", above=0.0, doc="1 sigma of each axis")
    attitude: float = quantity(0.002, unit="rad", above=0.0, doc="1 sigma about each axis")


@dataclass(frozen=True)
class UkfConfig:
    """The estimator's filter."""

    sensors: str = text("", doc="sensor file, config/sensors/<name>.yaml or a path, whose noise counts in place of `imu`; empty: none")
    imu: ImuNoise = part(ImuNoise)
    faults: ImuFaults = part(ImuFaults)
    rest: RestConfig = part(RestConfig)
    vio: VioNoise = part(VioNoise)
    alpha: float = quantity(1.0, above=0.0, high=1.0, doc="spread of the sigma points (Merwe); at 1 all weights are >= 0")
    beta: float = quantity(2.0, low=0.0, doc="prior knowledge of the distribution; 2 for a Gaussian")
    kappa: float = quantity(0.0, doc="secondary spread")
    gate_probability: float = quantity(0.999, above=0.0, high=0.999999, doc="chi2 gate of the innovation")
    history: float = quantity(0.5, unit="s", above=0.0, high=5.0, doc="IMU kept for replay: oldest usable VIO stamp")
    future: float = quantity(0.05, unit="s", low=0.0, high=0.5, doc="VIO stamps this far ahead wait for the IMU; later ones are refused")
    coasting_after: float = quantity(0.15, unit="s", above=0.0, doc="age of the last accepted VIO pose")
