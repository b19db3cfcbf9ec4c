"""The vehicle's body in its world: one control period after the other, without sensors and without ROS."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.scenario import Scenario
from perch_core.vehicle import Vehicle
from perch_sim import seeding
from perch_sim.attachment import FREE
from perch_sim.body import PLATE_POINTS, Body, make_body
from perch_sim.cable_contact import CableMonitor
from perch_sim.contact import ContactMonitor
from perch_sim.contact_event import ContactEvent
from perch_sim.dynamics import GRAVITY, STATES, Hold, advance, clearances
from perch_sim.obstacles import make_obstacles
from perch_sim.state_history import TrueState
from perch_sim.wind import WindField

PERIOD = 2_000_000  # control period [ns]
SUBSTEPS = 4        # Runge-Kutta steps per period: 0.5 ms each
STEP = PERIOD * 1e-9 / SUBSTEPS


class PlantOutput(NamedTuple):
    """What happened in one period."""

    states: tuple[TrueState, ...]       # at the end of each Runge-Kutta step, the last at the period's end
    inertial: np.ndarray                # mean specific force and angular velocity at the IMU in B, (6,)
    contacts: tuple[ContactEvent, ...]  # in order


def resting_state(scenario: Scenario, body: Body) -> np.ndarray:
    """The vehicle on the ground at the scenario's start, its plate's felt pressed by the weight, (13,)."""
    x = np.zeros(STATES)
    x[:3] = scenario.start.position
    x[2] += body.plate_offset - body.mass * GRAVITY / body.stiffness[:PLATE_POINTS].sum()
    yaw = np.radians(scenario.start.yaw_deg)
    x[5], x[6] = np.sin(yaw / 2), np.cos(yaw / 2)
    return x


class Plant:
    """Rigid body, rotors, wind and contact of a scenario."""

    def __init__(self, scenario: Scenario, vehicle: Vehicle, seed: int, start: int) -> None:
        """
        Args:
            scenario: where it flies, and how the real vehicle differs from its file.
            vehicle: the vehicle's file.
            seed: of the gusts.
            start: time of the initial state [ns].
        """
        self.body = make_body(vehicle, scenario.disturbance)
        self.obstacles = make_obstacles(scenario)
        self.contact = ContactMonitor(self.body.plate_offset, self.obstacles, scenario.adhesion)
        self.cables = CableMonitor(scenario.world.cables, scenario.grip, self.body.plate_offset, np.array(vehicle.body_radii))
        self.time = start
        self.rotor_speed = np.zeros(4)
        self._start = start
        self._x = resting_state(scenario, self.body)
        self._wind = WindField(scenario.wind, PERIOD * 1e-9, seeding.stream(seed, "wind"))
        self._distances = np.zeros((len(self.obstacles.names), 2))
        self._warm_up()

    @property
    def state(self) -> TrueState:
        """The present state."""
        x = self._x.copy()
        return TrueState(self.time, x[:3], x[3:7], x[7:10], x[10:13])

    @property
    def crashed(self) -> bool:
        """Whether the rotors are broken."""
        return self.contact.crashed or self.cables.crashed

    @property
    def hold(self) -> Hold:
        """What holds the vehicle: the velcro, the gripper, or nothing."""
        return self.contact.hold if self.contact.attached else self.cables.hold

    @property
    def rotor_thrust(self) -> np.ndarray:
        """Thrust of each rotor in free air, (4,) [N]."""
        return self.body.thrust_coefficient * self.rotor_speed**2

    def place(self, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray, w_WB_B: np.ndarray,
              rotor_speed: np.ndarray) -> None:
        """Put the vehicle into a state: the start of a test or of a study that begins in the air."""
        self._x = np.concatenate([p_WB, q_WB, v_WB, w_WB_B]).astype(float)
        self.rotor_speed = np.array(rotor_speed, float)

    def advance(self, target: np.ndarray) -> PlantOutput:
        """One control period.

        Args:
            target: rotor speeds that the motors aim at (4,) [rad/s].
        """
        wind = self._wind.next()
        total, sample = np.zeros(6), np.zeros(6)
        states, contacts = [], []
        for k in range(1, SUBSTEPS + 1):
            before = self._x.copy()
            aim = np.zeros(4) if self.crashed else target
            advance(self._x, self.rotor_speed, aim, wind, self.body, self.obstacles.surfaces, self.hold,
                    (self.time - self._start) * 1e-9 + (k - 1) * STEP, STEP, sample)
            total += sample
            time = self.time + k * PERIOD // SUBSTEPS
            x = self._x.copy()
            states.append(TrueState(time, x[:3], x[3:7], x[7:10], x[10:13]))
            contacts += self._touches(time, before)
        self.time += PERIOD
        elapsed = (self.time - self._start) * 1e-9
        contacts += [e._replace(time=self.time * 1e-9) for e in self.cables.update(elapsed, self._x)]
        return PlantOutput(tuple(states), total / SUBSTEPS, tuple(contacts))

    def _warm_up(self) -> None:
        """Compile the kernels now, on a copy of the state, rather than in the first step of a flight in real time."""
        advance(self._x.copy(), np.zeros(4), np.zeros(4), np.zeros(3), self.body, self.obstacles.surfaces,
                FREE, 0.0, STEP, np.zeros(6))
        clearances(self._x, self.body, self.obstacles.surfaces, 0.0, self._distances)

    def _touches(self, time: int, before: np.ndarray) -> list[ContactEvent]:
        elapsed = (time - self._start) * 1e-9  # surfaces move since the start
        least = clearances(self._x, self.body, self.obstacles.surfaces, elapsed, self._distances)
        if least > 0.0 and self.contact.free:
            return []
        events = self.contact.update(elapsed, before, self._x, self._distances)
        return [event._replace(time=time * 1e-9) for event in events]
