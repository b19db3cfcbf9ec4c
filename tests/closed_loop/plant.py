"""A quadrotor of its own for closed-loop tests: rotation matrices, forces per rotor, nothing shared with the code under test
but the vehicle's numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perch_core.component import Component, Input, Output
from perch_core.values import NANOSECONDS, ImuSample, MotorCommand, OdometryState, rotated
from perch_core.vehicle import Vehicle

G = np.array([0.0, 0.0, -9.81])


@dataclass
class Disturbances:
    """How the plant differs from the vehicle file."""

    mass_factor: float = 1.0
    inertia_factor: float = 1.0
    lag_factor: float = 1.0
    rotor_factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)


Vector = tuple[float, float, float]
Rows = tuple[Vector, Vector, Vector]
"""Of a matrix. In three dimensions plain floats are faster than arrays."""


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def times(A: Rows, x: Vector) -> Vector:
    """A x."""
    (a, b, c), (d, e, f), (g, h, i) = A
    x, y, z = x
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def transposed(A: Rows) -> Rows:
    """A^T."""
    (a, b, c), (d, e, f), (g, h, i) = A
    return (a, d, g), (b, e, h), (c, f, i)


def turn(phi: Vector) -> Rows:
    """Rotation matrix of a small rotation vector (Rodrigues)."""
    x, y, z = phi
    angle = math.sqrt(x * x + y * y + z * z)
    a, b = (1.0, 0.5) if angle < 1e-9 else (math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2)
    return ((1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
            (b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x),
            (b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)))


def quaternion(R: Rows) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a rotation matrix, by its largest component (Shepperd); SciPy's takes longer than a step of the controller."""
    (a, b, c), (d, e, f), (g, h, i) = R
    largest = max(a, e, i, a + e + i)
    q = ((h - f, c - g, d - b, 1.0 + a + e + i) if largest == a + e + i else (1.0 + a - e - i, b + d, c + g, h - f) if largest == a else
         (b + d, 1.0 + e - a - i, f + h, c - g) if largest == e else (c + g, f + h, 1.0 + i - a - e, d - b))
    n = math.hypot(*q)
    return q[0] / n, q[1] / n, q[2] / n, q[3] / n


def rotation_vector(R: Rows) -> Vector:
    """Of a rotation matrix, [rad]."""
    x, y, z, w = quaternion(R)
    sine = math.hypot(x, y, z)
    scale = (2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, abs(w)) / sine) * math.copysign(1.0, w)
    return scale * x, scale * y, scale * z


@dataclass
class Plant:
    """State of the vehicle; `advance` integrates it by one control period in sub-steps.

    The floor supports the vehicle and levels it; `wall` is a plane (point, outward normal) that the vehicle's underside cannot
    enter: an inelastic stop with a little friction.
    """

    vehicle: Vehicle
    p: np.ndarray
    v: np.ndarray = field(default_factory=lambda: np.zeros(3))
    R: np.ndarray = field(default_factory=lambda: np.eye(3))
    w: np.ndarray = field(default_factory=lambda: np.zeros(3))
    disturbances: Disturbances = field(default_factory=Disturbances)
    speed: np.ndarray | None = None
    wall: tuple[np.ndarray, np.ndarray] | None = None
    floor: float = 0.0
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros(3))
    impact_speed: float = 0.0

    def __post_init__(self) -> None:
        vehicle = self.vehicle
        if self.speed is None:
            self.speed = np.full(4, np.sqrt(vehicle.mass * 9.81 / 4 / vehicle.thrust_coefficient))
        self.p = np.array(self.p, float)
        # Torque of a unit thrust at each rotor: its lever, and its drag torque about b3.
        self._levers = tuple(zip(*((y, -x, s * vehicle.torque_ratio) for (x, y), s in zip(vehicle.rotor_xy, vehicle.rotor_yaw_sign))))

    def advance(self, command: np.ndarray, period: float = 0.002, substeps: int = 2) -> None:
        """Follow rotor speed commands [rad/s] for a control period [s]."""
        vehicle, dist = self.vehicle, self.disturbances
        dt = period / substeps
        share = 1 - math.exp(-dt / (vehicle.motor_time_constant * dist.lag_factor))
        mass, inertia = vehicle.mass * dist.mass_factor, [J * dist.inertia_factor for J in vehicle.inertia]
        strength, drag, wind = [vehicle.thrust_coefficient * factor for factor in dist.rotor_factor], vehicle.drag, dist.wind
        command, levers = np.asarray(command).tolist(), self._levers
        p, v, w, R, a, speed = (x.tolist() for x in (self.p, self.v, self.w, self.R, self.acceleration, self.speed))
        for _ in range(substeps):
            speed = [now + (wanted - now) * share for now, wanted in zip(speed, command)]
            thrust = [k * now * now for k, now in zip(strength, speed)]
            air = times(transposed(R), (v[0] - wind[0], v[1] - wind[1], v[2] - wind[2]))
            ax, ay, az = times(R, (-drag[0] * air[0], -drag[1] * air[1], -drag[2] * air[2] + sum(thrust)))
            a = [ax / mass, ay / mass, az / mass - 9.81]
            gyroscopic = cross(w, (inertia[0] * w[0], inertia[1] * w[1], inertia[2] * w[2]))
            dw = [(row[0] * thrust[0] + row[1] * thrust[1] + row[2] * thrust[2] + row[3] * thrust[3] - g) / J
                  for row, g, J in zip(levers, gyroscopic, inertia)]
            if p[2] <= self.floor + 1e-3 and v[2] + a[2] * dt <= 0.0:
                self.impact_speed = max(self.impact_speed, -v[2])
                a, v, w = [0.0, 0.0, -v[2] / dt], [0.0, 0.0, v[2]], [0.0, 0.0, 0.0]
                x, y, _ = rotation_vector(R)
                dw = [-x * 0.2 / dt, -y * 0.2 / dt, 0.0]
            w = [w[0] + dw[0] * dt, w[1] + dw[1] * dt, w[2] + dw[2] * dt]
            p = [x + y * dt + 0.5 * z * dt * dt for x, y, z in zip(p, v, a)]
            v = [v[0] + a[0] * dt, v[1] + a[1] * dt, v[2] + a[2] * dt]
            back = transposed(turn((w[0] * dt, w[1] * dt, w[2] * dt)))
            R = [times(back, R[0]), times(back, R[1]), times(back, R[2])]
            if self.wall is not None:
                point, normal = (x.tolist() for x in self.wall)
                depth = sum((x - y) * n for x, y, n in zip(p, point, normal))
                into = sum(x * n for x, n in zip(v, normal))
                if depth < 0 and into < 0:
                    p = [x - depth * n for x, n in zip(p, normal)]
                    v = [0.8 * (x - into * n) for x, n in zip(v, normal)]
        self.p, self.v, self.w, self.R, self.acceleration, self.speed = map(np.array, (p, v, w, R, a, speed))

    @property
    def specific_force_B(self) -> np.ndarray:
        """What an accelerometer at the centre of mass reads [m/s^2], shape (3,)."""
        return self.R.T @ (self.acceleration - G)

    @property
    def state(self) -> tuple[float, ...]:
        """p, v, q (xyzw), w as the controller takes them, 13 floats."""
        return (*self.p.tolist(), *self.v.tolist(), *quaternion(self.R.tolist()), *self.w.tolist())


@dataclass(frozen=True)
class NoParameters:
    """Of a component that has none."""


class PlantVehicle(Component[NoParameters]):
    """A plant as the vehicle of a flight loop: IMU and truth at every step, a motor command moves it to the next step.

    Attributes:
        time, next: stamps of the present and of the next step [ns].
    """

    config_type = NoParameters

    motor_command = Input(MotorCommand, "motor_command")
    imu = Output(ImuSample, "imu/data_raw")
    truth = Output(OdometryState, "ground_truth/odometry")

    def __init__(self, plant: Plant) -> None:
        super().__init__(NoParameters())
        self._plant, self.command = plant, None
        self.time, self.next = 0, NANOSECONDS

    def on_motor_command(self, command: MotorCommand) -> None:
        """Speeds for the period that begins now."""
        self.command = np.array(command.rotor_speed) if command.armed else np.zeros(4)

    def advance(self) -> list[Any]:
        """One control period; there are no cameras."""
        self.time, self.next = self.next, self.next + 2_000_000
        plant = self._plant
        if self.command is not None:
            plant.advance(self.command)
        self.imu(ImuSample(self.time, tuple(plant.w.tolist()), tuple(plant.specific_force_B.tolist())))
        self.truth(believed(self.time, plant.state))
        return []


def believed(stamp: int, state: tuple[float, ...]) -> OdometryState:
    """Odometry of 13 floats p, v in W, q, w."""
    p, v, q, w = state[0:3], state[3:6], state[6:10], state[10:13]
    return OdometryState(stamp, p, q, rotated(q, v, -1.0), w, np.zeros((6, 6)), np.zeros((6, 6)))


class EstimationError:
    """What odometry adds to the truth: slow errors of about 1.2 cm, 3 cm/s and 0.35 deg, and a little white noise."""

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        self._rng, self._scale = np.random.default_rng(seed), scale
        self._slow = np.concatenate([self._rng.normal(size=3) * s for s in (0.012, 0.0, 0.006)]) * scale

    def __call__(self, plant: Plant) -> tuple[float, ...]:
        """Odometry of the plant's state, 13 floats."""
        rng, k = self._rng, self._scale
        for i, (sigma, tau) in enumerate(((0.012, 0.5), (0.03, 0.1), (0.006, 0.5))):
            part = slice(3 * i, 3 * i + 3)
            self._slow[part] = self._slow[part] * np.exp(-0.002 / tau) + rng.normal(size=3) * sigma * k * np.sqrt(
                1 - np.exp(-0.004 / tau))
        R = plant.R @ turn((self._slow[6:] + rng.normal(size=3) * 0.0009 * k).tolist())
        return tuple(float(x) for x in (*(plant.p + self._slow[:3] + rng.normal(size=3) * 0.002 * k),
                                        *(plant.v + self._slow[3:6] + rng.normal(size=3) * 0.005 * k),
                                        *quaternion(R.tolist()), *(plant.w + rng.normal(size=3) * 0.01 * k)))
