"""What an inspection is judged by: collisions, and the measures of the paper's Fig. 5. [P:eq7, P:eq9, P:eq12, P:eq13]"""

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

SAMPLE = 0.01  # of the reference's states [s]
EVERY = 5      # true states are judged at 100 Hz


def segments(scenario: Scenario) -> list[Segment]:
    """The cables of a scenario, which are straight here, in W."""
    return [Segment.between(np.array(c.start), np.array(c.end), c.radius, k) for k, c in enumerate(scenario.world.cables)]


def watched(scenario: Scenario, lines: list[Segment]) -> Segment:
    """The line that the scenario's rough point means."""
    return min(lines, key=lambda s: float(s.distance(np.array(scenario.inspection.watched))))


def reference_of(scenario: Scenario, start_time: float = 0.0) -> FlatTrajectory:
    """The waypoint lines of a scenario."""
    places = [(np.array(w.position), float(np.radians(w.yaw_deg))) for w in scenario.inspection.waypoints]
    return waypoint_lines(places, scenario.inspection.speed, start_time)


def reference_states(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Times from its start [s], shape (n,), and states of the reference by flatness: p, q, v, w, shape (n, 13). [M:eq9-13]"""
    vehicle, source = packed_vehicle(load_vehicle(scenario.vehicle)), FlatReference(reference_of(scenario))
    times = np.arange(0.0, source.duration, SAMPLE)
    return times, np.array([reference_row(source.setpoint(float(t)).packed, 0.5, vehicle)[:13] for t in times])


def clearance(states: np.ndarray, lines: Sequence[Segment], radii: Vector3) -> np.ndarray:
    """Scaled distance of the nearest line minus 1 at each state, negative: the line is in the body, shape (n,)."""
    return np.min([scaled_clearance(states[:, 0:3], states[:, 3:7], line, radii) for line in lines], axis=0)


def collisions(clear: np.ndarray) -> int:
    """How often a line enters the body, from clearances, shape (n,)."""
    inside = np.concatenate([[False], clear < 0.0])
    return int(np.count_nonzero(~inside[:-1] & inside[1:]))


@dataclass(frozen=True)
class Judgement:
    """A way past the lines, judged.

    Attributes:
        clearance: scaled clearance of the nearest line, shape (n,). [P:eq7]
        seen: measures of the watched line, n states.
        corner: distance of the image's corners from its centre [px].
    """

    clearance: np.ndarray
    seen: Visibility
    corner: float

    @property
    def collisions(self) -> int:
        """How often a line enters the body."""
        return collisions(self.clearance)

    @property
    def reprojection(self) -> float:
        """Mean distance of the watched line from the image centre [px]; a line beyond the image's corners, or behind the camera, counts
        as at them, so that a way into the line does not count for more than one past it. [P:eq9]"""
        return float(np.mean(np.where(self.seen.cheirality, np.minimum(self.seen.reprojection, self.corner), self.corner)))


def judge(states: np.ndarray, lines: Sequence[Segment], line: Segment, vehicle: Vehicle) -> Judgement:
    """Judge states p, q, ..., shape (n, >= 7), against the true lines, of which `line` is to be watched."""
    mount = vehicle.mounts["front"]
    return Judgement(clearance(states, lines, vehicle.body_radii), visibility(states, line, mount),
                     float(np.hypot(mount.camera.width, mount.camera.height)) / 2)


@dataclass(frozen=True)
class Inspected:
    """A flown inspection beside its reference.

    Attributes:
        times: since the start of the reference [s], shape (n,).
        states: true p, q, ..., shape (n, >= 7).
        flown: the flight, judged by the true lines.
        reference_times, reference_states, reference: the same of the waypoint lines, as if flown exactly.
        lines, line: the true lines, and the watched one.
        crashes: how often the plant reports a collision.
        message: why the flight ended early; empty: it came to its end.
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

    @property
    def collisions(self) -> int:
        """Of the flight, by the plant or by the geometry of the states, whichever counts more."""
        return max(self.flown.collisions, self.crashes)


def inspected(scenario: Scenario, times: np.ndarray, states: np.ndarray, crashes: int = 0, message: str = "") -> Inspected:
    """A flight of a scenario, judged; arguments as the fields of `Inspected`."""
    vehicle, lines = load_vehicle(scenario.vehicle), segments(scenario)
    line = watched(scenario, lines)
    reference_times, reference = reference_states(scenario)
    return Inspected(times, states, judge(states, lines, line, vehicle), reference_times, reference,
                     judge(reference, lines, line, vehicle), lines, line, crashes, message)


def recorded(flight: Flight, scenario: Scenario, message: str = "") -> Inspected | None:
    """The last trajectory of a flight as an inspection; None where none was flown, or a cable sags (the measures are those of lines).

    Args:
        flight: what was flown.
        scenario: where the lines truly are.
        message: why it ended early, where that was no collision.
    """
    if scenario.mode != "inspection" or any(cable.sag > 0.0 for cable in scenario.world.cables):
        return None
    truth, orders = flight.states("ground_truth/odometry"), flight.values("trajectory")
    if truth is None or not orders:
        return None
    way = orders[-1][1].trajectory
    during = (truth.t >= way.start_time) & (truth.t <= way.start_time + way.duration)
    states = np.column_stack([truth.p, truth.q])[during][::EVERY]
    if len(states) < 2:
        return None
    crashes = [c for _, c in flight.values("contact") if c.state == ContactState.COLLISION]
    return inspected(scenario, truth.t[during][::EVERY] - way.start_time, states, len(crashes),
                     "; ".join(c.reason for c in crashes) or message)
