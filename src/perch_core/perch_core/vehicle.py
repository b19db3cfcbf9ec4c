"""Description of a vehicle: mass, rotors, sensors. Each vehicle is one YAML file in `config/vehicles/`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from perch_core import config, so3
from perch_core.arrays import Quaternion, Vector3, Vector4
from perch_core.camera import Camera, EquidistantCamera, PinholeCamera
from perch_core.camera_mount import CameraMount
from perch_core.config import DEFAULT_BOUNDS, choice, label, part, quantity, text
from perch_core.errors import ConfigError
from perch_core.extends import load_extended
from perch_core.sensors import check_camera_names, check_quaternion

GRAVITY = 9.81  # standard gravity of paper M [m/s^2]


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """A camera as the vehicle file describes it."""

    model: str = choice(options=("equidistant", "pinhole"), doc="projection model")
    width: int = quantity(unit="px", low=16, high=4096)
    height: int = quantity(unit="px", low=16, high=4096)
    focal: tuple[float, float] = quantity(unit="px", above=0.0, doc="fx, fy")
    centre: tuple[float, float] = quantity(unit="px", low=0.0, doc="cx, cy; within the image")
    distortion: Vector4 = quantity((0.0, 0.0, 0.0, 0.0), low=-10.0, high=10.0, doc="k1..k4 of the Kannala-Brandt polynomial")
    position: Vector3 = quantity(unit="m", low=-5.0, high=5.0, doc="p_BC")
    orientation: Quaternion = quantity(low=-1.01, high=1.01, doc="q_BC, xyzw")
    colour: bool = quantity(False, doc="rgb8 instead of mono8")
    rate: float = quantity(30.0, unit="Hz", above=0.0, high=120.0)
    exposure: float = quantity(0.0035, unit="s", above=0.0, high=0.03, doc="under light 1")
    exposure_max: float = quantity(0.0097, unit="s", above=0.0, high=0.03, doc="in the dark; at most the period of the frames")
    readout: float = quantity(0.0093, unit="s", low=0.0, high=0.05, doc="of a frame; at most the period of the frames")
    transport_min: float = quantity(0.005, unit="s", low=0.0, high=0.2)
    transport_max: float = quantity(0.010, unit="s", low=0.0, high=0.2)
    stamp_offset: float = quantity(0.0, unit="s", low=-0.05, high=0.05, doc="stamp minus true mid-exposure time")

    def __post_init__(self) -> None:
        check_quaternion("orientation", self.orientation)
        if self.model == "pinhole" and any(self.distortion):
            raise ConfigError("", "distortion", f"{list(self.distortion)} is of the model equidistant: a pinhole has none")
        if self.transport_max < self.transport_min:
            raise ConfigError("", "transport_max", f"{self.transport_max:g} is below transport_min {self.transport_min:g}")
        if self.centre[0] > self.width or self.centre[1] > self.height:
            raise ConfigError("", "centre", f"{list(self.centre)} px is outside the image, [0, {self.width}] x [0, {self.height}] px")
        if self.exposure > self.exposure_max:
            raise ConfigError("", "exposure", f"{self.exposure:g} s is above exposure_max {self.exposure_max:g} s")
        for key, value in (("exposure_max", self.exposure_max), ("readout", self.readout)):
            if value * self.rate > 1.0:
                raise ConfigError("", key, f"{value:g} s is outside [0, {1.0 / self.rate:.4g}] s, the period of frames at {self.rate:g} Hz")

    def mount(self, name: str) -> CameraMount:
        """Return the camera with its pose on the body."""
        common = self.width, self.height, *self.focal, *self.centre
        camera: Camera = EquidistantCamera(*common, coefficients=self.distortion) if self.model == "equidistant" else PinholeCamera(*common)
        return CameraMount(
            name=name, camera=camera, p_BC=np.array(self.position),
            R_BC=so3.quat_to_matrix(np.array(self.orientation) / np.linalg.norm(self.orientation)),
            rate=self.rate, exposure=self.exposure, exposure_max=self.exposure_max, readout=self.readout,
            transport_min=self.transport_min, transport_max=self.transport_max, stamp_offset=self.stamp_offset,
            colour=self.colour,
        )


@dataclass(frozen=True, kw_only=True)
class ImuConfig:
    """An IMU: ranges and noise, per sample at `rate`."""

    rate: float = quantity(500.0, unit="Hz", low=100.0, high=1000.0)
    position: Vector3 = quantity((0.0, 0.0, 0.0), unit="m", low=-5.0, high=5.0, doc="p_BI; axes parallel to B")
    accel_noise: float = quantity(unit="m/s^2", low=0.0, doc="1 sigma per sample, vibration included")
    gyro_noise: float = quantity(unit="rad/s", low=0.0, doc="1 sigma per sample")
    accel_bias_walk: float = quantity(unit="m/s^2/sqrt(s)", low=0.0)
    gyro_bias_walk: float = quantity(unit="rad/s/sqrt(s)", low=0.0)
    accel_bias_init: float = quantity(unit="m/s^2", low=0.0, doc="1 sigma of the turn-on bias")
    gyro_bias_init: float = quantity(unit="rad/s", low=0.0, doc="1 sigma of the turn-on bias")
    accel_range: float = quantity(156.0, unit="m/s^2", above=0.0)
    gyro_range: float = quantity(34.0, unit="rad/s", above=0.0)


@dataclass(frozen=True, kw_only=True)
class Battery:
    """Thrust at a given throttle as a function of the battery voltage: (thrust at `reference`) (voltage / reference)^exponent."""

    reference: float = quantity(0.0, unit="V", low=0.0, high=100.0, doc="at which the thrust curve holds; 0: the voltage is not used")
    exponent: float = quantity(2.0, low=0.5, high=4.0, doc="2: rotor speed proportional to voltage")
    range: tuple[float, float] = quantity((0.0, 100.0), unit="V", low=0.0, high=100.0, doc="between which it was identified")

    def __post_init__(self) -> None:
        if self.reference and not self.range[0] <= self.reference <= self.range[1]:
            raise ConfigError("", "actuation.battery.reference", f"{self.reference:g} V is outside its range {list(self.range)} V")


@dataclass(frozen=True, kw_only=True)
class Actuation:
    """Commands that the vehicle takes from the controller, and the response of the inner loop between them and the rotors.

    An inner loop is modelled by `w' = (rate_gain w_cmd - w) / rate_lag` on each axis and
    `T' = (thrust_gain T_cmd - T) / thrust_lag`, with commands delayed by `delay`; an attitude loop commands it the fed-forward
    rates + attitude error / `attitude_lag`.
    """

    type: str = choice("rotor_speeds", options=("rotor_speeds", "rates_and_thrust", "attitude_and_thrust"))
    delay: float = quantity(0.004, unit="s", low=0.0, high=0.1, doc="from a command's stamp to when the inner loop acts on it")
    rate_lag: Vector3 = quantity((0.03, 0.03, 0.06), unit="s", above=0.0, high=1.0, doc="axes of B")
    rate_gain: Vector3 = quantity((1.0, 1.0, 1.0), unit="-", above=0.1, high=10.0, doc="rate that is reached / commanded, axes of B")
    rate_max: float = quantity(20.0, unit="rad/s", above=0.0, high=100.0, doc="greatest rate that may be commanded about an axis")
    thrust_lag: float = quantity(0.03, unit="s", above=0.0, high=1.0)
    thrust_gain: float = quantity(1.0, unit="-", above=0.1, high=10.0, doc="thrust that is reached / commanded")
    attitude_lag: float = quantity(0.08, unit="s", above=0.0, high=1.0)
    battery: Battery = part(Battery)
    firmware: str = text("", doc="in simulation: Betaflight's own, set to config/autopilot/<name>.txt, is the inner loop; empty: an ideal one")

    def __post_init__(self) -> None:
        if self.firmware and self.type != "rates_and_thrust":
            raise ConfigError("", "actuation.firmware", f"takes rates_and_thrust, not {self.type}")


@dataclass(frozen=True, kw_only=True)
class ControlGains:
    """Gains of [M:eq2] per unit of mass and inertia: k_x = m position, k_v = m velocity, k_R = J attitude and
    k_Omega = J rate."""

    position: Vector3 = quantity((7.0, 7.0, 9.0), unit="1/s^2", low=0.0, high=200.0, doc="axes of W")
    velocity: Vector3 = quantity((4.5, 4.5, 5.5), unit="1/s", low=0.0, high=100.0, doc="axes of W")
    attitude: Vector3 = quantity((420.0, 420.0, 60.0), unit="1/s^2", low=0.0, high=5000.0, doc="axes of B")
    rate: Vector3 = quantity((32.0, 32.0, 10.0), unit="1/s", above=0.0, high=500.0, doc="axes of B")
    lead: float = quantity(0.02, unit="s", low=0.002, high=0.2, doc="time in which the rotors would reach a constant commanded thrust")


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A quadrotor. Rotors in the order front-left, rear-left, rear-right, front-right unless the file says otherwise."""

    name: str = label()
    mass: float = quantity(unit="kg", above=0.0, high=50.0)
    inertia: Vector3 = quantity(unit="kg m^2", above=0.0, doc="principal moments, axes of B")
    rotor_xy: tuple[tuple[float, float], ...] = quantity(unit="m", low=-5.0, high=5.0, doc="rotor positions in B")
    rotor_yaw_sign: tuple[int, int, int, int] = quantity(low=-1, high=1, doc="+1: the rotor's drag torque turns the body to +yaw")
    thrust_coefficient: float = quantity(unit="N s^2/rad^2", above=0.0, doc="thrust = coefficient * speed^2")
    torque_ratio: float = quantity(unit="m", above=0.0, high=1.0, doc="kappa of [P:eq2]: drag torque / thrust")
    speed_min: float = quantity(unit="rad/s", low=0.0)
    speed_max: float = quantity(unit="rad/s", above=0.0)
    motor_time_constant: float = quantity(unit="s", low=0.0, high=1.0, doc="first-order lag of the rotor speed")
    thrust_rate_max: float = quantity(float("inf"), unit="N/s", above=0.0, doc="|u| of [P:eq14g], per rotor")
    body_rate_max: float = quantity(unit="rad/s", above=0.0, doc="largest |omega| of a plan")
    drag: Vector3 = quantity((0.0, 0.0, 0.0), unit="N s/m", low=0.0, doc="linear rotor drag, axes of B")
    perch_offset: float = quantity(unit="m", low=0.0, high=1.0, doc="velcro or gripper below the centre of mass")
    stand_off: float = quantity(0.0, unit="m", low=0.0, high=0.2, doc="how far short of a wire the gripper is planned to stop")
    ground_offset: float | None = quantity(None, unit="m", low=0.0, high=2.0, doc="centre of mass above the ground at rest; left out: perch_offset")
    perch_radius: float = quantity(0.04, unit="m", above=0.0, high=1.0, doc="radius of the velcro plate")
    body_radii: Vector3 = quantity(unit="m", above=0.0, high=5.0, doc="ellipsoid that contains the vehicle")
    propeller_radius: float = quantity(0.0, unit="m", low=0.0, high=2.0)
    cameras: dict[str, CameraConfig] = text()
    imu: ImuConfig = text()
    actuation: Actuation = part(Actuation, doc="what it takes: rotor speeds, or the set points of an inner loop")
    gains: ControlGains = part(ControlGains, doc="how it is flown; the controller's parameters `gains` change it in flight")

    def __post_init__(self) -> None:
        check_camera_names(self.cameras)
        least, middle, most = sorted(self.inertia)
        radius = max(self.body_radii)
        for key, problem in (
            ("rotor_xy", len(self.rotor_xy) != 4 and f"has {len(self.rotor_xy)} rotors, needs 4"),
            ("rotor_yaw_sign", 0 in self.rotor_yaw_sign and f"{list(self.rotor_yaw_sign)} are not each 1 or -1"),
            ("inertia", most > 1.001 * (least + middle) and f"{most:g} is more than {least:g} + {middle:g} kg m^2, which is impossible for a rigid body"),
            ("inertia", most > self.mass * radius**2 and f"{most:g} kg m^2 is more than {self.mass:g} kg within {radius:g} m (body_radii) can have"),
            ("speed_max", self.speed_max <= self.speed_min and f"{self.speed_max:g} is not above speed_min {self.speed_min:g} rad/s"),
            ("speed_max", self.thrust_max > DEFAULT_BOUNDS["N"] and f"{self.thrust_max:.4g} N of a rotor is outside (0, {DEFAULT_BOUNDS['N']:g}] N"),
            ("speed_max", 4 * self.thrust_max <= self.hover_thrust and f"total thrust {4 * self.thrust_max:.2f} N cannot lift {self.mass:g} kg"),
            ("speed_min", 4 * self.thrust_min >= self.hover_thrust and f"with an idle thrust of {4 * self.thrust_min:.2f} N it cannot descend"),
            ("ground_offset", self.standing_height < self.perch_offset - 0.1 and f"{self.standing_height:g} m: its plate or gripper would be in the "
             f"ground, {self.perch_offset:g} m below the centre of mass; a file that changes perch_offset states ground_offset too"),
        ):
            if problem:
                raise ConfigError("", key, problem)
        if np.linalg.cond(self.allocation) > 1e6:
            raise ConfigError("", "rotor_xy", f"{[list(xy) for xy in self.rotor_xy]} m with these yaw signs leave an axis without moment")

    @cached_property
    def inertia_matrix(self) -> np.ndarray:
        """J in B [kg m^2], shape (3, 3). [M:eq1]"""
        return np.diag(self.inertia)

    @cached_property
    def allocation(self) -> np.ndarray:
        """Matrix from rotor thrusts to (collective thrust, Mx, My, Mz), shape (4, 4). [defines P:eq2]"""
        xy = np.array(self.rotor_xy)
        return np.stack([np.ones(4), xy[:, 1], -xy[:, 0], self.torque_ratio * np.array(self.rotor_yaw_sign, float)])

    @property
    def thrust_min(self) -> float:
        """Least thrust of one rotor [N]."""
        return self.thrust_coefficient * self.speed_min**2

    @property
    def thrust_max(self) -> float:
        """Greatest thrust of one rotor [N]."""
        return self.thrust_coefficient * self.speed_max**2

    def with_thrust_ratio(self, ratio: float) -> Vehicle:
        """Return the vehicle with rotors that produce `ratio` times the thrust.

        Raises:
            ConfigError: such a vehicle cannot fly.
        """
        return self if ratio == 1.0 else replace(self, thrust_coefficient=ratio * self.thrust_coefficient)

    @property
    def hover_thrust(self) -> float:
        """Collective thrust that carries the weight [N]."""
        return self.mass * GRAVITY

    @property
    def wire_offset(self) -> float:
        """Planned distance of the centre of mass from the axis of a wire at the end of a perch [m]."""
        return self.perch_offset + self.stand_off

    @property
    def standing_height(self) -> float:
        """Height of the centre of mass above the ground while the vehicle stands on it [m]."""
        return self.perch_offset if self.ground_offset is None else self.ground_offset

    @cached_property
    def mounts(self) -> dict[str, CameraMount]:
        """The cameras with their poses on the body, by name (`down`, `front`)."""
        return {name: item.mount(name) for name, item in self.cameras.items()}


def vehicle_file(name_or_path: str | Path) -> str:
    """Return the path of a vehicle's file, for messages; raises ConfigError where there is none."""
    return str(config.find("vehicles", name_or_path))


def load_vehicle(name_or_path: str | Path) -> Vehicle:
    """Return the vehicle of `config/vehicles/<name>.yaml`, or of a file, merged with the files that it extends.

    Raises:
        ConfigError: no such vehicle, or a value that is refused.
    """
    return load_extended(Vehicle, "vehicles", name_or_path)
