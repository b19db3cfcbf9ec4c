"""The loop: one control period after the other, every participant in the order of the lockstep."""

from __future__ import annotations

import time as clock
from collections import deque
from dataclasses import dataclass

import numpy as np

from perch_control.modes import Command, StepResult
from perch_control.parameters import ControllerParameters
from perch_control.mission import Target
from perch_control.mission.parameters import MissionParameters
from perch_control.ros.powerline_map import mapped_segments
from perch_core.camera import CameraMount
from perch_core.errors import PerchError
from perch_core.scenario import Scenario
from perch_core.tag_board import load_board
from perch_core.timing import CONTROL_PERIOD_NS, TICK_STEPS
from perch_eval.in_process.commanding import Commanding, goal_of
from perch_eval.in_process.estimation import STATUS_STEPS as HEALTH_STEPS
from perch_eval.in_process.estimation import Estimation, Odometry
from perch_eval.in_process.line_source import LineSource
from perch_eval.in_process.mailbox import Mailbox
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.in_process.piloting import STATUS_STEPS, FlownTrajectory, Piloting, PilotStatus
from perch_eval.in_process.planning import Planning, PowerlinePlanning
from perch_eval.in_process.stamps import SECOND, seconds
from perch_eval.in_process.target_source import ModelledSight, RenderedSight, TargetSource
from perch_eval.in_process.trace import FlightTrace
from perch_eval.in_process.vio_source import MEMORY, ModelledVio, RenderedVio
from perch_perception.powerline_mapper_node import PowerlineMapperConfig
from perch_perception.target_localizer_node import TargetLocalizerConfig
from perch_perception.ukf import ImuSample, UkfConfig
from perch_perception.vio_node import VioNodeConfig
from perch_planner.perching_planner_node import PerchingPlannerParameters
from perch_planner.powerline_planner_node import PowerlinePlannerParameters
from perch_sim import seeding
from perch_sim.calibration import true_mounts
from perch_sim.camera_stream import Delivery
from perch_sim.drawing import DrawnOnDemand
from perch_sim.participants import triggers
from perch_sim.simulation import Output, Simulation
from perch_sim.state_history import StateHistory
from perch_sim.vio_model import VioModelParameters

PATIENCE = 15 * SECOND  # for a cancelled flight to come to its end [ns]
ROTOR_STEPS = 5


@dataclass(frozen=True)
class Sensing:
    """Which cameras are rendered; the others are replaced by their error models."""

    vio: str = "model"
    target: str = "model"

    def __post_init__(self) -> None:
        for name in ("vio", "target"):
            if getattr(self, name) not in ("model", "rendered"):
                raise PerchError(f"sensing.{name}: {getattr(self, name)!r} is not one of model, rendered")

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras to render."""
        return (("down",) if self.vio == "rendered" else ()) + (("front",) if self.target == "rendered" else ())


class _Flight:
    """One flight in the making."""

    def __init__(self, scenario: Scenario, seed: int, sensing: Sensing) -> None:
        powerline = scenario.mode != "surface"
        if powerline and sensing.target != "rendered":
            raise PerchError(f"scenario {scenario.name}: powerlines have no error model; sensing.target must be rendered")
        params = NodeParameters(scenario, seed)
        self.scenario = scenario
        self.simulation = Simulation(scenario, seed, DrawnOnDemand(scenario, seed, sensing.cameras) if sensing.cameras else None)
        self.truth = StateHistory(MEMORY)
        self.truth.append(self.simulation.state)  # an exposure may have its middle before the first step ends
        vehicle = self.simulation.vehicle
        self.latency = {t.node: round(t.latency * 1e9)
                        for t in triggers(("vio", "target_localizer", "powerline_mapper", "mission"), scenario.latency)}
        self.finder = "powerline_mapper" if powerline else "target_localizer"
        down, front = vehicle.mounts["down"], vehicle.mounts["front"]
        if sensing.vio == "model":
            self.vio = ModelledVio(params.of("vio_model", VioModelParameters), down)
        else:
            self.vio = RenderedVio(params.of("vio", VioNodeConfig), down, vehicle.standing_height)
        if powerline:
            self.target = LineSource(params.of("powerline_mapper", PowerlineMapperConfig), front)
        else:
            self.target = self._target_source(seed, sensing, params.of("target_localizer", TargetLocalizerConfig), front)
        self.estimation = Estimation(params.of("estimator", UkfConfig))
        controller = params.of("controller", ControllerParameters)
        self.piloting = Piloting(controller, vehicle)
        self.reference_period = controller.controller.reference_period
        planning = None
        if scenario.mode == "powerline":
            planning = PowerlinePlanning(params.of("powerline_planner", PowerlinePlannerParameters))
        elif scenario.mode == "surface":
            planning = Planning(params.of("perching_planner", PerchingPlannerParameters), vehicle)
        self.commanding = Commanding(params.of("mission", MissionParameters).mission, planning, goal_of(scenario))
        self.trace = FlightTrace(self.simulation.pad)
        self.poses, self.sightings, self.orders = Mailbox(), Mailbox(), Mailbox()
        self.frames: dict[str, deque[Delivery]] = {"down": deque(), "front": deque()}
        self.index = 0
        self.status: PilotStatus | None = None

    def _target_source(self, seed: int, sensing: Sensing, localizer: TargetLocalizerConfig, front: CameraMount) -> TargetSource:
        """What sees the pad, by its error model or on rendered images."""
        board = load_board(localizer.board)
        if sensing.target == "rendered":
            return TargetSource(RenderedSight(board, front, localizer), front, localizer)
        true = true_mounts(self.scenario, {"front": front}, seed)["front"]
        return TargetSource(ModelledSight(board, front, true, localizer, seeding.stream(seed, "tag_corners"), self.truth,
                                          lambda: self.simulation.pad), front, localizer)

    def step(self, cancel: bool) -> int:
        """One control period. Returns its stamp [ns]."""
        output = self.simulation.advance()
        stamp, index = output.time, self.index
        time = seconds(stamp)
        imu = ImuSample(stamp, tuple(output.imu.gyro.tolist()), tuple(output.imu.accel.tolist()))
        self.truth.append(output.state)
        self.vio.see(output.state, imu)
        for pose in self.poses.released(stamp):
            self.estimation.add_vio(pose)
            self.trace.vio.append((time, pose))
        sightings = self.sightings.released(stamp)
        for sighting in sightings:
            if not isinstance(sighting, Target):
                self.piloting.see(mapped_segments(sighting))
        odometry = self.estimation.step(imu)
        result = self._control(time, imu, odometry, stamp)
        if index % STATUS_STEPS == 0:
            self.status = self.piloting.status
        for sighting in sightings:
            self.commanding.take(sighting)
            (self.trace.targets if isinstance(sighting, Target) else self.trace.maps).append((time, sighting))
        if index % HEALTH_STEPS == 0:
            health = self.estimation.status
            self.piloting.hear(health)
            self.commanding.hear(health)
            self.trace.estimator.append((time, health))
        self.commanding.feel(imu)
        self.target.add_odometry(odometry.body(time))
        self._look(stamp)
        if index % TICK_STEPS == 0:
            items = self.commanding.tick(stamp, odometry, self.status, cancel)
            self.orders.post(stamp + self.latency["mission"], items)
            self._note_orders(time, items)
        self._note(output, odometry, result, time)
        self.index += 1
        return stamp

    def _control(self, time: float, imu: ImuSample, odometry: Odometry, stamp: int) -> StepResult:
        released = [item for items in self.orders.released(stamp) for item in items]
        for item in sorted(released, key=lambda item: isinstance(item, FlownTrajectory)):  # commands, then trajectories
            if isinstance(item, FlownTrajectory):
                self.piloting.follow(item)
            else:
                self.piloting.command(Command(int(item[0])), item[1])
        result = self.piloting.step(time, imu, odometry)
        self.simulation.motors.command(self.simulation.time, result.armed, np.array(result.rotor_speed))
        return result

    def _look(self, stamp: int) -> None:
        """Take the frames that arrive at this step, and give those that can be answered to their consumers."""
        for name, node in (("down", "vio"), ("front", self.finder)):
            camera = self.simulation.cameras[name]
            if camera.due(stamp) is not None:
                self.frames[name].append(camera.take())
            waiting = self.frames[name]
            consumer = self.vio if name == "down" else self.target
            while waiting and consumer.covers(waiting[0]):
                delivery = waiting.popleft()
                due = max(delivery.frame.middle + self.latency[node], stamp + CONTROL_PERIOD_NS)
                answer = consumer.answer(delivery)
                if answer is not None:
                    (self.poses if name == "down" else self.sightings).post(due, answer)

    def _note(self, output: Output, odometry: Odometry, result: StepResult, time: float) -> None:
        trace, state, e = self.trace, output.state, odometry.estimate
        trace.stamps.append(output.time)
        trace.states.append((*state.p_WB.tolist(), *state.q_WB.tolist(), *state.v_WB.tolist(), *state.w_WB_B.tolist(),
                             *e.p_WB.tolist(), *e.q_WB.tolist(), *e.v_WB.tolist(), *e.w_WB_B.tolist()))
        trace.motors.append((float(result.armed), *result.rotor_speed))
        trace.contacts.extend(output.contacts)
        if result.setpoint is not None and self.index % self.reference_period == 0:
            x = result.setpoint
            trace.references.append((time, *x.p, *result.q_C, *x.v, *result.w_C, result.wrench[0]))
        if self.index % ROTOR_STEPS == 0:
            plant = self.simulation.plant
            trace.rotors.append((time, *plant.rotor_speed.tolist(), *plant.rotor_thrust.tolist()))
        if self.index % TICK_STEPS == 0:
            trace.covariances.append((time, odometry.covariance))

    def _note_orders(self, time: float, items: list) -> None:
        for item in items:
            if isinstance(item, FlownTrajectory):
                self.trace.trajectories.append((time, item))
            else:
                self.trace.commands.append((time, int(item[0]), item[1]))


def fly(scenario: Scenario, seed: int, sensing: Sensing = Sensing(), linger: float = 0.0) -> FlightTrace:
    """Fly a scenario once.

    Args:
        scenario: what is flown.
        seed: of everything that is random; the same seed gives the same flight to the last bit.
        sensing: which cameras are rendered.
        linger: flown on after the goal's end [s].

    Raises:
        ConfigError: the scenario or a node's parameter is refused.
        PerchError: something that this engine does not fly.
    """
    began = clock.perf_counter()
    flight = _Flight(scenario, seed, sensing)
    limit = round(scenario.time_limit * SECOND)
    stamp, cancelled = 0, False
    while flight.commanding.outcome is None and stamp < limit + PATIENCE:
        stamp = flight.step(cancelled)
        cancelled = stamp > limit
    end = stamp + round(linger * SECOND)
    while stamp < end:
        stamp = flight.step(False)
    trace, outcome = flight.trace, flight.commanding.outcome
    trace.pad, trace.phases = flight.simulation.pad, flight.commanding.phases
    trace.end_time = seconds(end - round(linger * SECOND))
    if outcome is None:
        trace.outcome, trace.message = "timeout", f"no end within {trace.end_time:.1f} s"
    else:
        trace.outcome, trace.message = outcome.result.name.lower(), outcome.message
        if trace.outcome == "cancelled" and cancelled:
            trace.outcome = "timeout"
        elif trace.outcome == "perched" and scenario.mode == "inspection":
            trace.outcome = "inspected"
    trace.wall_time = clock.perf_counter() - began
    return trace
