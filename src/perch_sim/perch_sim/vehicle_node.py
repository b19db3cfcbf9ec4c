"""Node `vehicle`: the simulated vehicle. It owns time; see docs/architecture.md, "Lockstep"."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import cv2
from perch_msgs.msg import MotorCommand, Step, StepReport
from rclpy.clock import Clock, ClockType

from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.composition import composition
from perch_core.ros.conversions import nanoseconds
from perch_core.ros.deadlines import durations_us
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.priority import priority
from perch_core.ros.wire import StepReading, read_motor_command, write_step
from perch_core.scenario import load_scenario
from perch_core.timing import CONTROL_PERIOD, CONTROL_PERIOD_NS, TICK_STEPS
from perch_sim.camera_stream import Delivery
from perch_sim.drawing import DrawnInProcesses
from perch_sim.motors import MotorCommandError
from perch_sim.pacing import Pacing
from perch_sim.parameters import CAMERAS, VehicleParameters
from perch_sim.participants import CONTROLLER, triggers
from perch_sim.phase_times import PhaseTimes
from perch_sim.ros.arrivals import Arrivals
from perch_sim.ros.lockstep_watch import LockstepWatch
from perch_sim.ros.vehicle_topics import VehicleTopics
from perch_sim.simulation import MOTOR_TIMEOUT, Output, Simulation

MOST_WAITING = 2        # images per camera that are being drawn in real time; a slow machine sees fewer, not older ones
CLOCK_STEPS = ROTOR_STEPS = TARGET_STEPS = 5  # 100 Hz
SEND_STEPS = 5                                # in real time other processes hear of so many steps at a time: 10 ms
REAL_TIME_MOTOR_TIMEOUT = 200_000_000         # with a busy operating system in between [ns]


class VehicleNode(PerchNode[VehicleParameters]):
    """Drives a `Simulation`: by motor commands in lockstep, by the wall clock in real time."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("vehicle", VehicleParameters, **kwargs)
        cv2.setNumThreads(1)
        params = self.params
        try:
            scenario = load_scenario(params.scenario)
            names = tuple(name for name in params.participants if name)
            slow = triggers(names, scenario.latency)
            self._drawing = DrawnInProcesses(scenario, params.seed, CAMERAS[params.cameras])
            self._simulation = Simulation(scenario, params.seed, self._drawing,
                                          MOTOR_TIMEOUT if params.lockstep else REAL_TIME_MOTOR_TIMEOUT)
        except ConfigError:
            self.destroy_node()
            raise
        self._topics = VehicleTopics(self, self._simulation.vehicle.imu, self._simulation.vehicle.mounts)
        self._steps = composition.publisher(self, Step, "step", qos.STEP)
        self._ticks = self.create_publisher(Step, "tick", qos.STEP)
        self._released: dict[str, int] = {}    # since the last tick
        self._output: Output | None = None     # of the step that is to be published next
        self._index = 0
        self._times = PhaseTimes()
        self._last_command = 0
        self._published = 0.0                  # when the present step was, wall clock [s]
        self._command_delays: deque[float] = deque(maxlen=500)
        self._counts = {"commands_missed": 0, "commands_refused": 0, "images_late": 0}
        self._busy = False
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        composition.subscription(self, MotorCommand, "motor_command", self._receive_command, qos.CHAIN)
        self.create_timer(1.0, self._diagnose, clock=steady)
        self._watch: LockstepWatch | None = None
        self._pacing: Pacing | None = None
        self._allowance = 0                    # steps that the wall clock allows a flight without controller
        composition.hold_back(not params.lockstep)
        if params.lockstep:
            self._idle_clock = self.create_timer(CONTROL_PERIOD, self._advance, clock=steady)
            self._idle_clock.cancel()
            self._watch = LockstepWatch(self, slow, CONTROLLER in names, [*self._topics.publishers(), self._steps, self._ticks],
                                        params.lockstep_timeout, params.start_timeout, self._drawing.ready)
            self._arrivals = Arrivals(self._simulation.cameras, self._watch)
            self.create_subscription(StepReport, "step_report", self._receive_report, qos.GATED)
            self.create_timer(0.05, self._look_after, clock=steady)
        else:
            for camera in self._simulation.cameras.values():
                camera.most_waiting = MOST_WAITING
            self._pacing = Pacing(CONTROL_PERIOD_NS, time.monotonic_ns())
            self.create_timer(CONTROL_PERIOD, self._keep_pace, clock=steady)

    # -- inputs ------------------------------------------------------------------------------------------------------

    def _receive_command(self, data: bytes) -> None:
        stamp, armed, rotor_speed = read_motor_command(data)
        try:
            self._simulation.motors.command(self._simulation.time, armed, rotor_speed)
        except MotorCommandError as error:
            self._counts["commands_refused"] += 1
            self.get_logger().error(str(error), throttle_duration_sec=1.0)
        self._last_command = max(self._last_command, stamp)
        if stamp == self._simulation.time:
            self._command_delays.append(time.perf_counter() - self._published)
        if self._watch is not None:
            self._watch.command(stamp)
            self._advance()

    def _receive_report(self, msg: StepReport) -> None:
        self._watch.report(msg.node, nanoseconds(msg.trigger), {r.topic: r.count for r in msg.published})
        self._advance()

    # -- lockstep ----------------------------------------------------------------------------------------------------

    def _look_after(self) -> None:
        self._watch.look_after(self._output.time if self._output else 0)
        self._advance()

    def _advance(self) -> None:
        """Go as far as the participants allow."""
        if self._busy:
            return
        self._busy = True
        try:
            while self._step_in_lockstep():
                pass
        finally:
            self._busy = False

    def _step_in_lockstep(self) -> bool:
        """One transition; false when something has to be waited for."""
        watch = self._watch
        if self._output is None:
            if not watch.may_advance() or not self._in_time():
                return False
            self._times.end("waiting")
            self._output = self._simulation.advance()
            self._times.end("physics")
            for name in self._arrivals.take(self._output.time):
                if self._simulation.cameras[name].broken:
                    self.get_logger().error(f"camera_{name}: the process that draws its images has ended: no images any more", once=True)
        stamp = self._output.time
        missing = watch.missing(stamp)
        awaited = self._arrivals.crowded() | {trigger.camera for trigger in watch.triggers if trigger.node in missing}
        if awaited:
            self._publish_frames(self._arrivals.drawn(awaited))
            return not missing and not self._arrivals.crowded()
        for trigger in watch.triggers:
            if trigger.period and self._index % trigger.period == 0:
                watch.trigger(trigger.node, stamp, stamp + round(trigger.latency * 1e9))
        self._publish(watch.begin(stamp))
        self._publish_frames(self._arrivals.drawn())
        return True

    def _in_time(self) -> bool:
        """A flight that no controller leads keeps to the wall clock instead of running away."""
        if self._watch.led:
            if self._pacing is not None:
                self._pacing = None
                self._idle_clock.cancel()
            return True
        if self._pacing is None:
            self._pacing = Pacing(CONTROL_PERIOD_NS, time.monotonic_ns())
            self._idle_clock.reset()
        if self._allowance == 0:
            self._allowance = self._pacing.due(time.monotonic_ns())
        if self._allowance == 0:
            return False
        self._allowance -= 1
        return True

    # -- real time ---------------------------------------------------------------------------------------------------

    def _keep_pace(self) -> None:
        if self._index == 0:
            problem = priority.ask()
            if problem:
                self.get_logger().warning(problem)
        for behind in reversed(range(self._pacing.due(time.monotonic_ns()))):
            self._times.end("waiting")
            if 0 < self._last_command < self._simulation.time:
                self._counts["commands_missed"] += 1
            self._output = self._simulation.advance()
            self._times.end("physics")
            frames = []
            for name, camera in self._simulation.cameras.items():
                delivery = camera.due(self._output.time)
                if delivery is None:
                    continue
                if delivery.image is None or delivery.image.done():
                    frames.append((name, camera.take()))
                else:
                    self._counts["images_late"] += 1  # one step each: it goes out when it is drawn
            composition.at_once(lambda: self._publish_paced(frames), until=0 if behind else self._pacing.next_due)

    def _publish_paced(self, frames: list[tuple[str, Delivery]]) -> None:
        self._publish({})
        if frames:
            composition.later(lambda: self._publish_frames(frames))

    # -- output ------------------------------------------------------------------------------------------------------

    def _publish(self, released: dict[str, int]) -> None:
        """Publish this step and what it shows: first what the control loop waits for, which in real time goes on before the rest."""
        output, index = self._output, self._index
        self._topics.publish_imu(output.time, output.imu)
        self._steps.publish(self._step(output.time, index, released))
        self._published = time.perf_counter()
        self._released |= released
        self._index, self._output = index + 1, None
        self._times.count_step()
        if self._watch is not None:
            self._show(output, index)
        else:
            self._times.end("publishing")
            composition.later(lambda: self._show(output, index))

    def _show(self, output: Output, index: int) -> None:
        """Publish what has happened in a step, and the tick."""
        topics = self._topics
        if self._watch is None:
            self._times.end("waiting")
            if index % SEND_STEPS == 0:
                composition.in_spare_time(lambda: self._tell(output.time, index))
        elif index % TICK_STEPS == 0:
            self._tell(output.time, index)
        if index % CLOCK_STEPS == 0:
            topics.publish_clock(output.time)
        topics.publish_truth(output.state)
        for event in output.contacts:
            topics.publish_contact(event)
            self._log_contact(event)
        if index == 0 or (index % TARGET_STEPS == 0 and any(self._simulation.scenario.target.velocity)):
            if self._simulation.scenario.mode == "surface":
                topics.publish_target(output.time, self._simulation.pad)
        if index % ROTOR_STEPS == 0:
            plant = self._simulation.plant
            topics.publish_rotors(output.time, plant.rotor_speed, plant.rotor_thrust)
        self._times.end("publishing")

    def _tell(self, stamp: int, index: int) -> None:
        """Send other processes what they have not heard yet, and the tick."""
        composition.flush()
        if index % TICK_STEPS == 0:
            self._ticks.publish(self._step(stamp, index, self._released))
            self._released = {}

    def _publish_frames(self, frames: list[tuple[str, Delivery]]) -> None:
        """Publish camera_info and image of frames; those who use them then know everything that came before."""
        if not frames:
            return
        composition.flush()
        for name, delivery in frames:
            self._topics.cameras[name].publish(delivery.frame.stamp, delivery.image.result() if delivery.image else None)
        self._times.end("publishing")

    def _step(self, stamp: int, index: int, released: dict[str, int]) -> bytes:
        return write_step(StepReading(stamp, index, self._watch is not None, tuple(released.items())))

    def _log_contact(self, event: Any) -> None:
        self.get_logger().info(f"t = {event.time:.3f} s: {event.body}: {event.state.name.lower()}"
                               + (f" ({event.reason})" if event.reason else ""))

    def _diagnose(self) -> None:
        self._times.end("waiting")
        values: dict[str, Any] = {"time_s": self._simulation.time * 1e-9, "steps": self._index,
                                  **self._times.report(CONTROL_PERIOD), **self._counts,
                                  "motors_timed_out": self._simulation.motors.timed_out,
                                  "crashed": self._simulation.plant.crashed}
        values |= durations_us("command", self._command_delays)
        level, message = 0, "ok"
        if self._watch is None:
            values["images_dropped"] = sum(camera.dropped for camera in self._simulation.cameras.values())
            values |= {"deadlines_missed": self._pacing.misses, "periods_skipped": self._pacing.skipped}
        elif self._watch.waiting:
            message = f"waiting for {self._watch.waiting}"
        if self._simulation.motors.timed_out:
            level, message = 1, "motors stopped: no motor_command"
        if self._simulation.plant.crashed:
            level, message = 2, "crashed"
        self.publish_diagnostics(self._simulation.time * 1e-9, values, level, message)

    def close(self) -> None:
        """End the drawing processes."""
        self._drawing.close()


def create(**kwargs: Any) -> VehicleNode:
    """The node, alone or composed."""
    return VehicleNode(**kwargs)


def main() -> None:
    """Entry point of `ros2 run perch_sim vehicle`."""
    spin_main(create)


if __name__ == "__main__":
    main()
