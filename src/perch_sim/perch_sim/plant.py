"""Plant: rigid body, rotors, wind and contact, advanced by control periods; without sensors and without ROS."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from perch_core.errors import ConfigError, PerchError
from perch_core.values import Contact
from perch_core.vehicle import GRAVITY, Vehicle, vehicle_file
from perch_sim import seeding
from perch_sim.attachment import FREE
from perch_sim.body import PLATE_POINTS, Body, hold_rate, make_body
from perch_sim.cable_contact import CableMonitor
from perch_sim.contact import ContactMonitor
from perch_sim.dynamics import STATES, Hold, advance_to_touch, clearances
from perch_sim.obstacles import make_obstacles
from perch_sim.scenario import Scenario
from perch_sim.state_history import TrueState
from perch_sim.timing import CONTROL_PERIOD, CONTROL_PERIOD_NS
from perch_sim.wind import WindField

SUBSTEPS = 4        # Runge-Kutta steps per period: 0.5 ms each
STEP = CONTROL_PERIOD / SUBSTEPS
START_DEPTH = 0.01  # to which the vehicle may stand in a surface at the start [m]
STABLE = 2.78       # greatest (rate of a decay) * (step) at which a Runge-Kutta step of fourth order decays, too


class PlantOutput(NamedTuple):
    """Output of one control period."""

    states: list[TrueState]        # at the end of each Runge-Kutta step, the last at the period's end
    inertial: np.ndarray           # mean specific force and angular velocity at the IMU in B, (6,)
    contacts: tuple[Contact, ...]  # in order


def resting_state(scenario: Scenario, body: Body) -> np.ndarray:
    """Return the state at rest on the ground at the scenario's start, the felt of the plate compressed by the weight, (13,)."""
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
            scenario: world of the flight, and differences of the true vehicle from its file.
            vehicle: vehicle as its file describes it.
            seed: seed of the flight, for the gusts.
            start: time of the initial state [ns].

        Raises:
            ConfigError: the board does not exist, the vehicle would stand in the panel, in a wall, on its rotors or on legs, a disturbance
                does not suit it, or the plate is so far from the centre of mass that steps of 0.5 ms cannot follow its hold.
        """
        self.body = make_body(vehicle, scenario.disturbance)
        if hold_rate(self.body) * STEP > STABLE:
            raise ConfigError(vehicle_file(scenario.vehicle), "perch_offset", f"{vehicle.perch_offset:g} m is too far for {self.body.mass:g} kg with "
                              f"inertias of {', '.join(f'{J:.3g}' for J in self.body.inertia)} kg m^2: the hold would be unstable")
        self.obstacles = make_obstacles(scenario)
        self.contact = ContactMonitor(self.body.plate_offset, self.obstacles, scenario.adhesion)
        self.cables = CableMonitor(scenario.world.cables, scenario.grip, self.body.plate_offset, np.array(vehicle.body_radii))
        self.time = start
        self.rotor_speed = np.zeros(4)
        self._start = start
        self._x = resting_state(scenario, self.body)
        height = float(self._x[2]) - scenario.start.position[2]
        if vehicle.ground_offset is not None and abs(vehicle.ground_offset - height) > START_DEPTH:
            raise ConfigError(vehicle_file(scenario.vehicle), "ground_offset", f"{vehicle.ground_offset:g} m: the simulated vehicle stands on its "
                              f"plate, at {height:.3f} m")
        self._wind = WindField(scenario.wind, CONTROL_PERIOD, seeding.stream(seed, "wind"))
        self._touched = np.zeros((len(self.obstacles.names), 3))
        self._warm_up()
        self._check_start(scenario)

    @property
    def state(self) -> TrueState:
        """The present state."""
        return TrueState(self.time, self._x.copy())

    @property
    def crashed(self) -> bool:
        """Whether the vehicle has crashed; its motors then stop."""
        return self.contact.crashed or self.cables.crashed

    @property
    def hold(self) -> Hold:
        """Hold of the vehicle by the velcro or the gripper, or `FREE`."""
        return self.contact.hold if self.contact.attached else self.cables.hold

    def release(self) -> None:
        """Release velcro and gripper, as a latch on the arming line of the motors does."""
        self.contact.release()
        self.cables.release()

    @property
    def rotor_thrust(self) -> np.ndarray:
        """Thrust of each rotor in free air, (4,) [N]."""
        return self.body.thrust_coefficient * self.rotor_speed**2

    def place(self, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray, w_WB_B: np.ndarray,
              rotor_speed: np.ndarray) -> None:
        """Set the state of the vehicle, for tests and studies that begin in the air."""
        self._x = np.concatenate([p_WB, q_WB, v_WB, w_WB_B]).astype(float)
        self.rotor_speed = np.array(rotor_speed, float)

    def advance(self, target: np.ndarray) -> PlantOutput:
        """Advance one control period.

        Args:
            target: target speeds of the rotors (4,) [rad/s].

        Raises:
            PerchError: the state is not finite.
        """
        wind = self._wind.next()
        path, total, done, contacts = np.empty((SUBSTEPS, STATES)), np.zeros(6), 0, []
        while done < SUBSTEPS:
            last = SUBSTEPS if self.contact.free else done + 1
            before = path[done - 1] if done else self._x.copy()
            begin = (self.time - self._start) * 1e-9 + done * STEP
            made, touched = advance_to_touch(
                self._x, self.rotor_speed, np.zeros(4) if self.crashed else target, wind, self.body,
                self.obstacles.surfaces, self.hold, begin, STEP, path[done:last], total, self._touched)
            before = path[done + made - 2] if made > 1 else before
            done += made
            if touched or not self.contact.free:
                contacts += self._touches(self.time + done * CONTROL_PERIOD_NS // SUBSTEPS, before)
        states = [TrueState(self.time + (k + 1) * CONTROL_PERIOD_NS // SUBSTEPS, x) for k, x in enumerate(path)]
        self.time += CONTROL_PERIOD_NS
        if not math.isfinite(self._x[0]):  # what is not finite reaches the position within two steps
            raise PerchError(f"the state of the simulated vehicle is not finite {(self.time - self._start) * 1e-9:.3f} s after the start")
        elapsed = (self.time - self._start) * 1e-9
        contacts += [e._replace(stamp=self.time) for e in self.cables.update(elapsed, self._x)]
        return PlantOutput(states, total / SUBSTEPS, tuple(contacts))

    def _check_start(self, scenario: Scenario) -> None:
        """Check that the vehicle stands on its plate, and in nothing; a panel flush with the floor gives way as the floor does."""
        clearances(self._x, self._x, self.body, self.obstacles.surfaces, 0.0, self._touched)
        for name, (plate, rest, _) in zip(self.obstacles.names, self._touched):
            if name == "floor" and rest < 0.0:
                raise ConfigError(vehicle_file(scenario.vehicle), "perch_offset", f"{self.body.plate_offset:g} m: the vehicle would stand on its "
                                  f"rotors, as its weight presses the plate's felt by {-plate:.3f} m")
            if name != "floor" and min(plate, rest) < -START_DEPTH:
                (x, y, z), place = scenario.start.position, "panel around the pad" if name in ("pad", "panel") else name
                raise ConfigError("", "start.position", f"({x:g}, {y:g}, {z:g}) m: the vehicle would stand in the {place}")

    def _warm_up(self) -> None:
        """Compile the kernels on a copy of the state, so that the first step of a flight in real time is not delayed."""
        advance_to_touch(self._x.copy(), np.zeros(4), np.zeros(4), np.zeros(3), self.body, self.obstacles.surfaces, FREE,
                         0.0, STEP, np.empty((1, STATES)), np.zeros(6), self._touched)

    def _touches(self, time: int, before: np.ndarray) -> list[Contact]:
        """Return the contact events at a time [ns]; `before` is the state one step earlier."""
        elapsed = (time - self._start) * 1e-9  # surfaces move since the start
        events = self.contact.update(elapsed, before, self._x, self._touched)
        return [event._replace(stamp=time) for event in events]
