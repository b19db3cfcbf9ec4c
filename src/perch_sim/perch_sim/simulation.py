"""The simulated vehicle without ROS: plant, motors, IMU and camera times of a scenario and a seed.

The same scenario, seed and commands give the same flight, bit by bit. The vehicle node advances it in lockstep or in
real time; tests and studies can advance it with any controller in a loop:

    flight = Simulation(load_scenario("surface_90"), seed=1)
    while flight.time < 5 * NANOSECONDS:
        flight.motors.command(flight.time, True, controller(flight.state))
        output = flight.advance()
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.values import NANOSECONDS, Contact
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle, vehicle_file
from perch_sim import seeding
from perch_sim.calibration import true_imu, true_mounts
from perch_sim.camera_stream import CameraStream
from perch_sim.camera_timing import CameraTiming
from perch_sim.drawing import Rendering
from perch_sim.imu import Imu, ImuSample
from perch_sim.inner_loop import inner_loop
from perch_sim.lockstep.tasks import START
from perch_sim.motors import Motors
from perch_sim.obstacles import pad_surface
from perch_sim.plant import SUBSTEPS, Plant
from perch_sim.rendering.sensor import control_exposure
from perch_sim.scenario import Scenario
from perch_sim.state_history import StateHistory, TrueState
from perch_sim.timing import CONTROL_PERIOD_NS

MEMORY = 60_000_000     # how far back an exposure may reach [ns]
MOTOR_TIMEOUT = 100_000_000  # a motor controller stops without commands for so long [ns]


class Output(NamedTuple):
    """Output of one control period."""

    time: int                           # end of the period [ns]
    imu: ImuSample
    state: TrueState
    contacts: tuple[Contact, ...]


class Simulation:
    """A vehicle in flight. All times are on the IMU's clock [ns]."""

    def __init__(self, scenario: Scenario, seed: int, drawing: Rendering | None = None) -> None:
        """
        Args:
            scenario: scenario of the flight.
            seed: seed of all random streams.
            drawing: renders the images of some cameras; of the others, only the frame times are simulated.

        Raises:
            ConfigError: the scenario's vehicle or board does not exist, its IMU does not run at the control rate, or a disturbance
                does not suit the vehicle.
        """
        self.scenario = scenario
        self.vehicle: Vehicle = load_vehicle(scenario.vehicle)
        if round(NANOSECONDS / self.vehicle.imu.rate) != CONTROL_PERIOD_NS:
            raise ConfigError(vehicle_file(scenario.vehicle), "imu.rate",
                              f"{self.vehicle.imu.rate:g} is not the control rate of {NANOSECONDS / CONTROL_PERIOD_NS:g} Hz, the only one that is simulated")
        self.plant = Plant(scenario, self.vehicle, seed, START)
        self.motors, self._starts = Motors(self.vehicle.speed_min, self.vehicle.speed_max, MOTOR_TIMEOUT), 0
        self.loop = inner_loop(self.vehicle, scenario.disturbance.loop_lag_factor, scenario.disturbance.voltage_factor)
        self.imu = Imu(true_imu(self.vehicle.imu, seed), seeding.stream(seed, "imu"))
        self._sample = ImuSample(np.array([0.0, 0.0, GRAVITY]), np.zeros(3))
        self._history = StateHistory(MEMORY * SUBSTEPS // CONTROL_PERIOD_NS)
        self._history.append(self.plant.state)
        self.cameras = self._make_cameras(seed, drawing)

    def _make_cameras(self, seed: int, drawing: Rendering | None) -> dict[str, CameraStream]:
        cameras, mounts = {}, self.vehicle.mounts
        for name, true in true_mounts(self.scenario, mounts, seed).items():
            exposure = control_exposure(true, self.scenario.world.light).time
            timing = CameraTiming(true, exposure, START, seeding.stream(seed, f"timing_{name}"))
            draw = partial(drawing.draw, name) if drawing is not None and name in drawing.cameras else None
            cameras[name] = CameraStream(mounts[name], timing, draw, seeding.stream(seed, f"noise_{name}"),
                                         np.array(self.scenario.target.velocity), START)
        return cameras

    @property
    def time(self) -> int:
        """Simulation time [ns]."""
        return self.plant.time

    @property
    def state(self) -> TrueState:
        """True state."""
        return self.plant.state

    @property
    def pad(self) -> PerchSurface:
        """The true pad at the present time."""
        return pad_surface(self.scenario, (self.time - START) * 1e-9)

    def advance(self) -> Output:
        """Advance one control period with the present command; starting the motors releases velcro and gripper."""
        if self.motors.starts != self._starts:
            self._starts = self.motors.starts
            self.plant.release()
        result = self.plant.advance(self._target_speeds())
        for state in result.states:
            self._history.append(state)
        for camera in self.cameras.values():
            camera.expose(self.time, self._history)
        self._sample = self.imu.sample(result.inertial)
        return Output(self.time, self._sample, result.states[-1], result.contacts)

    def _target_speeds(self) -> np.ndarray:
        """Return the target speeds of the rotors, (4,) [rad/s]; a loop that handles the loss of commands arms and stops them itself."""
        if self.loop is None:
            return self.motors.target(self.time)
        speeds = self.loop.speeds(self.time, self.state.x, self.plant.rotor_speed, self._sample)
        if self.loop.handles_command_timeout:
            return np.asarray(speeds)
        self.motors.aim(speeds)
        return self.motors.target(self.time)

    def close(self) -> None:
        """End the inner loop's firmware, if there is one."""
        if self.loop is not None:
            self.loop.close()
