"""A quadrotor of its own for closed-loop tests: rotation matrices, forces per rotor, nothing shared with the code under test
but the vehicle's numbers."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

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


@dataclass
class Plant:
    """State of the vehicle; `advance` integrates it by one control period in sub-steps.

    The floor is a stiff, damped support under the body; `wall` is a plane (point, outward normal) that the body's
    underside cannot enter: an inelastic stop with a little friction.
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

    def advance(self, command: np.ndarray, period: float = 0.002, substeps: int = 2) -> None:
        """Follow rotor speed commands [rad/s] for a control period [s]."""
        vehicle, dist = self.vehicle, self.disturbances
        dt = period / substeps
        tau = vehicle.motor_time_constant * dist.lag_factor
        mass = vehicle.mass * dist.mass_factor
        J = np.array(vehicle.inertia) * dist.inertia_factor
        arms = [np.array([x, y, 0.0]) for x, y in vehicle.rotor_xy]
        for _ in range(substeps):
            self.speed = self.speed + (np.asarray(command) - self.speed) * (1 - np.exp(-dt / tau))
            thrust = vehicle.thrust_coefficient * self.speed**2 * np.array(dist.rotor_factor)
            force, torque = np.zeros(3), np.zeros(3)
            for arm, f, sign in zip(arms, thrust, vehicle.rotor_yaw_sign):
                force += (0.0, 0.0, f)
                torque += np.cross(arm, (0.0, 0.0, f)) + (0.0, 0.0, sign * vehicle.torque_ratio * f)
            airspeed_B = self.R.T @ (self.v - np.array(dist.wind))
            force -= np.array(vehicle.drag) * airspeed_B
            a = self.R @ force / mass + G
            dw = (torque - np.cross(self.w, J * self.w)) / J
            if self.p[2] <= self.floor + 1e-3 and a[2] < 0 and self.v[2] <= 0.3:
                self.impact_speed = max(self.impact_speed, -self.v[2])
                a = np.array([0.0, 0.0, -self.v[2] / dt])
                self.v[:2] = 0
                tilt = Rotation.from_matrix(self.R).as_rotvec() * (1, 1, 0)
                self.w, dw = np.zeros(3), -tilt * 0.2 / dt
            self.acceleration = a
            self.w = self.w + dw * dt
            self.p = self.p + self.v * dt + 0.5 * a * dt**2
            self.v = self.v + a * dt
            self.R = self.R @ Rotation.from_rotvec(self.w * dt).as_matrix()
            if self.wall is not None:
                point, normal = self.wall
                depth = float((self.p - point) @ normal)
                if depth < 0 and self.v @ normal < 0:
                    self.p = self.p - depth * normal
                    self.v = 0.8 * (self.v - (self.v @ normal) * normal)

    @property
    def specific_force_B(self) -> np.ndarray:
        """What an accelerometer at the centre of mass reads [m/s^2], shape (3,)."""
        return self.R.T @ (self.acceleration - G)

    def state(self, rng: np.random.Generator | None = None, sigma=(0.0, 0.0, 0.0, 0.0)) -> tuple[float, ...]:
        """p, v, q (xyzw), w as the controller takes them, 13 floats, with white noise of p, v, angle and rate."""
        p, v, R, w = self.p, self.v, self.R, self.w
        if rng is not None:
            p = p + sigma[0] * rng.normal(size=3)
            v = v + sigma[1] * rng.normal(size=3)
            R = R @ Rotation.from_rotvec(sigma[2] * rng.normal(size=3)).as_matrix()
            w = w + sigma[3] * rng.normal(size=3)
        return tuple(float(x) for x in (*p, *v, *Rotation.from_matrix(R).as_quat(), *w))
