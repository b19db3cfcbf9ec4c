"""Measures of an inspection: collisions, and the quantities of the paper's Fig. 5. [P:eq7, P:eq9, P:eq12, P:eq13]"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perch_control.geometric import packed_vehicle
from perch_control.mission.waypoints import waypoint_lines
from perch_control.nmpc.reference_rows import reference_row
from perch_control.reference import FlatReference
from perch_core.arrays import Vector3
from perch_core.lines import Segment, scaled_clearance
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.flight import Flight
from perch_planner.powerline.visibility import Visibility, visibility
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario

SAMPLE_TIME = 0.01  # of the reference's states [s]
DOWNSAMPLING = 5    # true states are judged at 100 Hz


def segments(scenario: Scenario) -> list[Segment]:
    """Return the cables of a scenario as straight segments in W."""
    return [Segment.between(np.array(c.start), np.array(c.end), c.radius, k) for k, c in enumerate(scenario.world.cables)]


def watched(scenario: Scenario, lines: list[Segment]) -> Segment:
    """Return the line nearest to the scenario's approximate point, which is the line to watch."""
    return min(lines, key=lambda s: float(s.distance(np.array(scenario.inspection.watched))))


def reference_of(scenario: Scenario, start_time: float = 0.0) -> FlatTrajectory:
    """Return the reference trajectory: straight lines between the waypoints of a scenario."""
    places = [(np.array(w.position), float(np.radians(w.yaw_deg))) for w in scenario.inspection.waypoints]
    return waypoint_lines(places, scenario.inspection.speed, start_time)


def reference_states(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return times since the reference's start [s], (n,), and its states by flatness, p, q, v, w, (n, 13). [M:eq9-13]"""
    vehicle, source = packed_vehicle(load_vehicle(scenario.vehicle)), FlatReference(reference_of(scenario))
    times = np.arange(0.0, source.duration, SAMPLE_TIME)
    return times, np.array([reference_row(source.setpoint(float(t)).packed, 0.5, vehicle)[:13] for t in times])


def clearance(states: np.ndarray, lines: Sequence[Segment], radii: Vector3) -> np.ndarray:
    """Return the scaled distance of the nearest line minus 1 at each state, shape (n,); negative: the line is in the body."""
    return np.min([scaled_clearance(states[:, 0:3], states[:, 3:7], line, radii) for line in lines], axis=0)


def collisions(clear: np.ndarray) -> int:
    """Return how often a line enters the body, from clearances of shape (n,)."""
    inside = np.concatenate([[False], clear < 0.0])
    return int(np.count_nonzero(~inside[:-1] & inside[1:]))


@dataclass(frozen=True)
class Judgement:
    """Measures of a path past the lines.

    Attributes:
        clearance: scaled clearance of the nearest line, shape (n,). [P:eq7]
        visibility: visibility of the watched line at n states.
    """

    clearance: np.ndarray
    visibility: Visibility

    @property
    def collisions(self) -> int:
        """Number of times that a line enters the body."""
        return collisions(self.clearance)

    @property
    def reprojection(self) -> float:
        """Mean limited distance of the watched line from the image centre [px]: a path into the line does not weigh more than one past
        it. [P:eq9]"""
        return float(self.visibility.reprojection.mean())


def judge(states: np.ndarray, lines: Sequence[Segment], line: Segment, vehicle: Vehicle) -> Judgement:
    """Compute the measures of states p, q, ..., shape (n, >= 7), with the true lines; `line` is the watched one."""
    return Judgement(clearance(states, lines, vehicle.body_radii), visibility(states, line, vehicle.mounts["front"]))


@dataclass(frozen=True)
class InspectionResult:
    """Flown inspection and its reference.

    Attributes:
        times: times since the start of the reference [s], shape (n,).
        states: true p, q, ..., shape (n, >= 7).
        flown: measures of the flight, with the true lines.
        reference_times, reference_states, reference: the same of the reference, the waypoint lines flown exactly.
        lines, line: the true lines, and the watched one.
        crashes: number of collisions that the plant reports.
        message: why the flight ended early; empty: it was completed.
        mapped: number of lines in the map at the start of the reference: others can be avoided only if they come into view in time.
    """

    times: np.ndarray
    states: np.ndarray
    flown: Judgement
    reference_times: np.ndarray
    reference_states: np.ndarray
    reference: Judgement
    lines: list[Segment]
    line: Segment
    crashes: int
    message: str
    mapped: int

    @property
    def collisions(self) -> int:
        """Number of collisions of the flight: the larger of those by the plant and by the geometry of the states."""
        return max(self.flown.collisions, self.crashes)


def inspection_result(scenario: Scenario, times: np.ndarray, states: np.ndarray, crashes: int = 0, message: str = "",
                      mapped: int = 0) -> InspectionResult:
    """Compute the measures of a scenario's flight; arguments as the fields of `InspectionResult`."""
    vehicle, lines = load_vehicle(scenario.vehicle), segments(scenario)
    line = watched(scenario, lines)
    reference_times, reference = reference_states(scenario)
    return InspectionResult(times, states, judge(states, lines, line, vehicle), reference_times, reference,
                            judge(reference, lines, line, vehicle), lines, line, crashes, message, mapped)


def recorded_inspection(flight: Flight, scenario: Scenario, message: str = "") -> InspectionResult | None:
    """Return the last trajectory of a flight as an inspection; None if there is none, or a cable sags (measures need lines).

    Args:
        flight: the flight.
        scenario: scenario with the true lines.
        message: why the flight ended early, if not by a collision.
    """
    if scenario.mode != "inspection" or any(cable.sag > 0.0 for cable in scenario.world.cables):
        return None
    truth, orders = flight.states("ground_truth/odometry"), flight.values("trajectory")
    if truth is None or not orders:
        return None
    trajectory = orders[-1][1].trajectory
    during = (truth.t >= trajectory.start_time) & (truth.t <= trajectory.start_time + trajectory.duration)
    states = np.column_stack([truth.p, truth.q])[during][::DOWNSAMPLING]
    if len(states) < 2:
        return None
    maps = [lines for time, lines in flight.values("powerlines") if time <= trajectory.start_time]
    crashes = [c for _, c in flight.values("contact") if c.state == ContactState.COLLISION]
    return inspection_result(scenario, truth.t[during][::DOWNSAMPLING] - trajectory.start_time, states, len(crashes),
                             "; ".join(c.reason for c in crashes) or message, len(maps[-1].lines) if maps else 0)
