"""Component of the node `vehicle`: commands for motors or inner loop in; IMU, cameras, truth, contact and simulation time out."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from perch_core import so3
from perch_core.component import Component, Diagnostics, Input, LogLine, Output, Timer
from perch_core.errors import ConfigError, PerchError
from perch_core.urdf import fixed_frames, optical_frame
from perch_core.values import (
    NANOSECONDS, AttitudeThrust, CameraImage, CameraModel, Contact, ImuSample, MotorCommand, OdometryState, PoseStamped, RatesThrust, RotorState,
    Transform, limits, rotated, seconds)
from perch_core.vehicle import load_vehicle, vehicle_file
from perch_sim.camera_stream import Delivery
from perch_sim.contact_event import ContactState
from perch_sim.drawing import Rendering, ProcessRendering
from perch_sim.lockstep.batches import Arrival
from perch_sim.motors import MotorCommandError
from perch_sim.pacing import Pacing
from perch_sim.parameters import CAMERAS, VehicleParameters
from perch_sim.scenario import Scenario, load_scenario
from perch_sim.simulation import Simulation
from perch_sim.state_history import TrueState
from perch_sim.timing import CONTROL_PERIOD, CONTROL_PERIOD_NS

SLOW_STEPS = 5                         # steps from one clock, rotor state or pose of a moving pad to the next: 100 Hz
MAX_PENDING_IMAGES = 2                 # images per camera being rendered in real time: a slow machine gets fewer, not older ones
REAL_TIME_MOTOR_TIMEOUT = 200_000_000  # with a busy operating system in between [ns]
COMMANDS_MISSED = 0.25                 # share of steps without a new command in a second above which it warns
COMMANDS = {"rotor_speeds": "motor_command", "rates_and_thrust": "rates_thrust_command", "attitude_and_thrust": "attitude_thrust_command"}
"""Actuation of a vehicle -> topic of its commands."""
EXACT = np.zeros((6, 6))               # covariance of the truth

MakeRendering = Callable[[Scenario, int, Collection[str]], Rendering]


class SimulatedVehicle(Component[VehicleParameters]):
    """Advances a `Simulation`: step by step if a schedule calls `advance`, by the host's time if the host calls `on_pace`.

    Attributes:
        scenario: scenario of the flight.
        simulation: the simulated vehicle.
        time: stamp of the last step [ns].
    """

    config_type = VehicleParameters

    motor_command = Input(MotorCommand, COMMANDS["rotor_speeds"], answered=True)
    rates_thrust = Input(RatesThrust, COMMANDS["rates_and_thrust"], answered=True)
    attitude_thrust = Input(AttitudeThrust, COMMANDS["attitude_and_thrust"], answered=True)
    pace = Timer(CONTROL_PERIOD)
    imu = Output(ImuSample, "imu/data_raw")
    truth = Output(OdometryState, "ground_truth/odometry")
    target = Output(PoseStamped, "ground_truth/target")
    rotors = Output(RotorState, "rotor_state")
    contact = Output(Contact, "contact")
    clock = Output(int, "/clock")
    frames = Output(Transform, "/tf_static")
    info_down, image_down = Output(CameraModel, "camera_down/camera_info"), Output(CameraImage, "camera_down/image_raw")
    info_front, image_front = Output(CameraModel, "camera_front/camera_info"), Output(CameraImage, "camera_front/image_raw")

    def __init__(self, config: VehicleParameters, scenario: Scenario | None = None, drawing: MakeRendering = ProcessRendering) -> None:
        """
        Args:
            config: parameters.
            scenario: scenario of the flight; None: the one that the parameters name.
            drawing: renders images, `ProcessRendering` or `OnDemandRendering`.

        Raises:
            ConfigError: the scenario, its vehicle or its board does not exist; the vehicle has a camera that is not simulated, or
                lacks the one that is to take images.
            PerchError: the vehicle's firmware is not on this machine, or does not start.
        """
        super().__init__(config)
        scenario = load_scenario(config.scenario) if scenario is None else scenario
        self.scenario = scenario = replace(scenario, vehicle=config.vehicle) if config.vehicle else scenario
        cameras = self._rendered_cameras()
        self._drawing = drawing(scenario, config.seed, cameras) if cameras else None
        try:
            self.simulation = Simulation(scenario, config.seed, self._drawing)
            self._cameras = {name: self._ports(name) for name in self.simulation.cameras}
        except PerchError:
            if self._drawing is not None:
                self._drawing.close()
            raise
        self.time = self.simulation.time
        self._index = 0                          # steps so far
        self._last_command = 0                   # newest stamp of a command that was not refused
        self._pacing: Pacing | None = None       # in real time
        self._broken: set[str] = set()           # cameras without images for the rest of the flight
        self._diagnosed, self._last_counts = self.time, (0, 0)  # time of the last diagnostics; steps and missed commands by then
        self._counts = {"commands_missed": 0, "commands_refused": 0, "images_late": 0}

    def _rendered_cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras that take images: of `all`, those that the vehicle has."""
        wanted, mounts = CAMERAS[self.config.cameras], load_vehicle(self.scenario.vehicle).mounts
        if len(wanted) == 1 and wanted[0] not in mounts:
            raise ConfigError(vehicle_file(self.scenario.vehicle), f"cameras.{wanted[0]}", "missing; it is to take images")
        return tuple(name for name in wanted if name in mounts)

    def warm_up(self) -> None:
        """Restrict OpenCV to one thread, as its threads would compete with the flight for the processors."""
        cv2.setNumThreads(1)

    def ready(self) -> bool:
        """Return whether images can be rendered without a start-up delay."""
        return self._drawing is None or self._drawing.ready()

    def close(self) -> None:
        """End the rendering processes and the inner loop's firmware, where there are any."""
        self.simulation.close()
        if self._drawing is not None:
            self._drawing.close()

    # -- inputs ------------------------------------------------------------------------------------------------------

    def on_motor_command(self, command: MotorCommand) -> None:
        """Set rotor speeds, which take effect in the next step."""
        self._apply_command("rotor_speeds", command, command.rotor_speed)

    def on_rates_thrust(self, command: RatesThrust) -> None:
        """Pass body rates and thrust to the inner loop."""
        self._apply_command("rates_and_thrust", command, command.w_B, command.thrust)

    def on_attitude_thrust(self, command: AttitudeThrust) -> None:
        """Pass attitude and thrust to the inner loop."""
        self._apply_command("attitude_and_thrust", command, command.w_B, command.thrust, command.q_WB)

    def _apply_command(self, kind: str, command: MotorCommand | RatesThrust | AttitudeThrust, *content: Any) -> None:
        """Pass a command to the motors or to the inner loop; log a refused command and the reason."""
        simulation = self.simulation
        try:
            if kind != simulation.vehicle.actuation.type:
                raise MotorCommandError(f"{simulation.vehicle.name} takes {simulation.vehicle.actuation.type}, not {kind}: ignored")
            if command.stamp < self._last_command:
                raise MotorCommandError(f"{kind}: of {seconds(command.stamp):.3f} s, older than the one before: ignored")
            if simulation.loop is not None and (problem := limits.problem(command)):
                raise MotorCommandError(f"{kind}: {problem}")
            if simulation.loop is None:
                simulation.motors.command(self.time, command.armed, *content)
            else:
                simulation.loop.command(self.time, command.armed, *content)
                simulation.motors.command(self.time, command.armed, simulation.plant.rotor_speed.tolist())
        except MotorCommandError as error:
            self._counts["commands_refused"] += 1
            self.log(LogLine("error", str(error), 1.0))
        else:
            if self._last_command < command.stamp <= self.time:
                self._last_command = command.stamp

    # -- stepping ----------------------------------------------------------------------------------------------------

    def advance(self) -> list[Arrival]:
        """Advance one control period with the present command, and emit its outputs; images may not be rendered yet.

        Returns:
            Camera frames that have arrived.
        """
        self._step()
        arrivals = []
        for name, camera in self.simulation.cameras.items():
            if camera.due(self.time) is not None:
                arrivals.append(self._emit_frame(name, camera.take()))
        return arrivals

    def on_pace(self, now: int) -> None:
        """Advance all periods that the host's time [ns] has reached; emit images when they are rendered."""
        if self._pacing is None:
            # calls come at multiples of the period: steps become due a little before, so that rounding shifts none to the next call
            self._pacing = Pacing(CONTROL_PERIOD_NS, now - CONTROL_PERIOD_NS // 4)
            self.simulation.motors.timeout = REAL_TIME_MOTOR_TIMEOUT
            for camera in self.simulation.cameras.values():
                camera.max_pending_images = MAX_PENDING_IMAGES
        for _ in range(self._pacing.due(now)):
            if 0 < self._last_command < self.time:
                self._counts["commands_missed"] += 1
            self._step()
            for name, camera in self.simulation.cameras.items():
                delivery = camera.due(self.time)
                if delivery is None:
                    continue
                if delivery.image is None or delivery.image.on_demand or delivery.image.done():
                    self._emit_frame(name, camera.take())
                else:
                    self._counts["images_late"] += 1  # one step each: it is emitted when it is rendered
            if self.time - self._diagnosed >= NANOSECONDS:
                self.diagnose()

    def _step(self) -> None:
        output, index = self.simulation.advance(), self._index
        time = self.time = output.time
        if index == 0:
            for frame in fixed_frames(self.simulation.vehicle):
                self.frames(frame)
        self.imu(ImuSample(time, tuple(output.imu.gyro.tolist()), tuple(output.imu.accel.tolist())))
        if self.truth.has_receivers:
            self.truth(true_odometry(output.state))
        for event in output.contacts:
            self._emit_contact(event)
        if index % SLOW_STEPS == 0:
            self._emit_slow(index)
        self._index += 1

    def _emit_slow(self, index: int) -> None:
        plant, scenario = self.simulation.plant, self.scenario
        self.clock(self.time)
        if self.rotors.has_receivers:
            self.rotors(RotorState(self.time, tuple(plant.rotor_speed.tolist()), tuple(plant.rotor_thrust.tolist())))
        if scenario.mode == "surface" and (index == 0 or any(scenario.target.velocity)):
            pad = self.simulation.pad
            self.target(PoseStamped(self.time, tuple(pad.p_WS.tolist()), tuple(so3.quat_from_matrix(pad.R_WS).tolist())))

    def _emit_contact(self, event: Contact) -> None:
        self.contact(event)
        state = ContactState(event.state).name.lower()
        self.info(f"t = {event.stamp * 1e-9:.3f} s: {event.body}: {state}" + (f" ({event.reason})" if event.reason else ""))

    # -- cameras -----------------------------------------------------------------------------------------------------

    def _ports(self, camera: str) -> tuple[Callable[[CameraModel], None], Callable[[CameraImage], None]]:
        try:
            return getattr(self, f"info_{camera}"), getattr(self, f"image_{camera}")
        except AttributeError:
            raise ConfigError(vehicle_file(self.scenario.vehicle), f"cameras.{camera}",
                              "is not one of down, front, which are simulated") from None

    def _emit_frame(self, name: str, delivery: Delivery) -> Arrival:
        """Emit a frame: its camera model, and its image if there is one."""
        stream, frame, pending = self.simulation.cameras[name], delivery.frame, delivery.image
        if stream.broken and name not in self._broken:
            self._broken.add(name)
            self.log(LogLine("error", f"camera_{name}: the process that renders its images has ended: no more images"))
        info, emit = self._cameras[name]
        camera, image = stream.mount.camera, None
        info(CameraModel(frame.stamp, optical_frame(name), camera))
        if pending is not None:
            image = CameraImage(frame.stamp, optical_frame(name), camera.width, camera.height, "rgb8" if stream.mount.colour else "mono8",
                                pending.result, None if pending.on_demand else pending.done)
            emit(image)
        return Arrival(name, frame.stamp, frame.middle, image)

    # -- diagnostics -------------------------------------------------------------------------------------------------

    def diagnose(self) -> None:
        """Emit diagnostics; warn if too many commands are missed."""
        self._diagnosed = self.time
        simulation = self.simulation
        values = {"time_s": self.time * 1e-9, "steps": self._index, **self._counts, "motors_timed_out": simulation.motors.timed_out,
                  "crashed": simulation.plant.crashed}
        if self._pacing is not None:
            values |= {"images_dropped": sum(camera.dropped for camera in simulation.cameras.values()),
                       "deadlines_missed": self._pacing.misses, "periods_skipped": self._pacing.skipped}
        steps, missed = self._index - self._last_counts[0], self._counts["commands_missed"] - self._last_counts[1]
        self._last_counts = self._index, self._counts["commands_missed"]
        level, message = 0, "ok"
        if missed > COMMANDS_MISSED * steps:
            level, message = 1, f"{100 * missed / steps:.0f} % of the controller's commands are lost or late"
            self.warn(message, min_interval=5.0)
        if simulation.motors.timed_out:
            level, message = 1, f"motors stopped: no {COMMANDS[simulation.vehicle.actuation.type]}"
        if simulation.plant.crashed:
            level, message = 2, "crashed"
        self.diagnostics(Diagnostics(self.time, values, level, message))


def true_odometry(state: TrueState) -> OdometryState:
    """Return a true state as odometry."""
    x = state.x.tolist()
    q = tuple(x[3:7])
    return OdometryState(state.time, tuple(x[0:3]), q, rotated(q, x[7:10], -1.0), tuple(x[10:13]), EXACT, EXACT)
