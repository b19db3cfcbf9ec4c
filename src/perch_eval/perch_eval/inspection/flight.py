"""One inspection, flown by the algorithm cores: plant, IMU, VIO model, UKF, NMPC; no ROS. [P:VI-A]

The controller knows the state that the estimator has and a map with an error; truth enters through the sensors' models alone.
"""

from __future__ import annotations

import numpy as np

from perch_control.admission import AtEnd
from perch_control.modes import Command, State
from perch_control.parameters import ControllerParameters
from perch_core.errors import PerchError
from perch_core.lines import Segment
from perch_core.scenario import Scenario
from perch_core.trajectory import rest_to_rest
from perch_eval.in_process.estimation import STATUS_STEPS as HEALTH_STEPS
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.in_process.piloting import FlownTrajectory, Piloting
from perch_eval.in_process.sensed_vehicle import SensedVehicle
from perch_eval.inspection.measures import Inspected, inspected, reference_of, segments
from perch_perception.ukf import Health
from perch_sim import seeding
from perch_sim.contact_event import ContactEvent, ContactState

MAP_ERROR = 0.02   # 1 sigma of each axis of both ends of a mapped line [m]; the mapper's bar is 3 cm
MAP_STEPS = 50     # the map is published at 10 Hz
LEAD = 0.04        # from an order to its start [s]
SETTLE = 1.0       # hover before the line terms begin [s]
RECORD = 5         # every so many steps


def mapped(lines: list[Segment], rng: np.random.Generator) -> list[Segment]:
    """Lines as a mapper finds them: each end is off by `MAP_ERROR`."""
    return [Segment.between(*(end + MAP_ERROR * rng.normal(size=3) for end in line.ends), line.radius, line.id) for line in lines]


class _Flight:
    def __init__(self, scenario: Scenario, seed: int) -> None:
        params = NodeParameters(scenario, seed)
        self.sensing = SensedVehicle(scenario, params, seed)
        controller = params.of("controller", ControllerParameters)
        self.piloting = Piloting(controller, self.sensing.simulation.vehicle)
        self.ramp = controller.nmpc.lines.ramp_time
        self.map: list[Segment] = []
        self.contacts: list[ContactEvent] = []
        self.rows: list[tuple[float, ...]] = []

    @property
    def time(self) -> float:
        return self.sensing.time

    def step(self) -> None:
        sensing, index = self.sensing, self.sensing.index
        output = sensing.step()
        if self.map and index % MAP_STEPS == 0:
            self.piloting.see(self.map)
        result = self.piloting.step(self.time, sensing.imu, sensing.odometry)
        sensing.simulation.motors.command(sensing.simulation.time, result.armed, np.array(result.rotor_speed))
        if index % HEALTH_STEPS == 0:
            self.piloting.hear(sensing.estimation.status)
        self.contacts.extend(output.contacts)
        if index % RECORD == 0:
            x = output.state
            self.rows.append((self.time, *x.p_WB.tolist(), *x.q_WB.tolist(), *x.v_WB.tolist(), *x.w_WB_B.tolist()))

    def run(self, duration: float) -> None:
        end = self.time + duration
        while self.time < end and not self.sensing.simulation.plant.crashed:
            self.step()


def fly(scenario: Scenario, seed: int, with_lines: bool = True) -> Inspected:
    """Take off below the first waypoint, let the line terms grow, fly the waypoint lines.

    Args:
        scenario: mode `inspection`.
        seed: of everything that is random.
        with_lines: False: the controller is not told of the lines, and follows the reference as it is.

    Raises:
        PerchError: the scenario is not an inspection, or the vehicle does not take off.
    """
    if scenario.mode != "inspection":
        raise PerchError(f"scenario {scenario.name}: mode {scenario.mode!r} is not inspection")
    flight = _Flight(scenario, seed)
    _take_off(flight, scenario)
    if with_lines:
        flight.map = mapped(segments(scenario), seeding.stream(seed, "line_map"))
    flight.run(flight.ramp + SETTLE)
    start = flight.time + LEAD
    trajectory = reference_of(scenario, start)
    flight.piloting.follow(FlownTrajectory(2, trajectory, AtEnd.HOLD))
    flight.run(LEAD)
    flight.rows.clear()
    flight.run(trajectory.duration)
    table = np.array(flight.rows)
    crashes = [c.reason for c in flight.contacts if c.state is ContactState.COLLISION]
    status = flight.piloting.status
    flying = State(status.state) in (State.TRACKING, State.HOVERING)
    message = "; ".join(crashes) or ("" if flying else status.message)
    return inspected(scenario, table[:, 0] - start, table[:, 1:], len(crashes), message)


def _take_off(flight: _Flight, scenario: Scenario) -> None:
    first = scenario.inspection.waypoints[0]
    while flight.sensing.estimation.status.health is not Health.RUNNING:
        if flight.time > 10.0:
            raise PerchError(f"the estimator is not ready: {flight.sensing.estimation.status.message}")
        flight.step()
    flight.run(0.2)
    flight.piloting.command(Command.ARM, "inspection")
    flight.run(0.2)
    yaw = float(np.radians(first.yaw_deg))
    duration = max(2.0, first.position[2] / 0.8)
    rise = rest_to_rest(flight.sensing.odometry.estimate.p_WB, np.array(first.position), yaw, yaw, duration, flight.time + LEAD)
    flight.piloting.follow(FlownTrajectory(1, rise, AtEnd.HOLD))
    flight.run(duration + LEAD + SETTLE)
    if State(flight.piloting.status.state) is not State.HOVERING:
        raise PerchError(f"did not take off: {flight.piloting.status.message}")
