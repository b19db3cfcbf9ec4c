"""[P] Table I, flown part: perches on lines with rendered cameras, and their errors at the perching point."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from perch_core import so3
from perch_core.extends import extended_mapping
from perch_core.lines import Segment
from perch_core.trajectory import SampledTrajectory
from perch_core.values import TrajectoryOrder, seconds
from perch_core.vehicle import Vehicle
from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task, fly_in_process
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Run
from perch_eval.ending import MAX_HOVER_SPEED
from perch_eval.evaluation.kept import cached_runs
from perch_eval.evaluation.sections import Effort
from perch_eval.flight import Flight
from perch_eval.in_process import Sensing
from perch_eval.metrics import MISSION, contact_of
from perch_sim.cable_contact import CableLine
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario

ENGINE = "perch_eval.evaluation.powerline_flights:fly_line"
RENDERED = Sensing(vio="rendered", target="rendered")
CASES_WITHOUT_GRIP = ("line_80", "line_20", "line_180")  # also flown with a gripper that never closes: all must recover
SEEDS_WITHOUT_GRIP = 3
LEAST_HEIGHT = 0.8  # of a hover at the end [m]
MAP_RADIUS = 1.5  # around the target point within which the map is judged [m]


def fly_line(task: Task) -> RunResult:
    """Fly one perch on a line, as with the real nodes; its metrics include the errors at the perching point."""
    return fly_in_process(task, _errors, linger=0.5)


def _errors(flight: Flight, scenario: Scenario, vehicle: Vehicle) -> dict[str, float | None]:
    return {**perching_errors(flight, scenario, vehicle.wire_offset), **mapping_errors(flight, scenario),
            "other_lines_touched": float(_others_touched(flight, scenario)), "hovers_at_end": float(hovers_at_end(flight))}


def _target(scenario: Scenario) -> int:
    """Return the index of the cable nearest to the goal's perch point."""
    point = np.array(scenario.mission.perch_point)
    return int(np.argmin([CableLine(cable).nearest(point).distance for cable in scenario.world.cables]))


def _others_touched(flight: Flight, scenario: Scenario) -> int:
    """Return the number of contacts with cables other than the target."""
    target, states = f"cable {_target(scenario)}", (1, 2, 3)
    return sum(c.state in states and c.body.startswith("cable") and c.body != target for _, c in flight.values("contact"))


def _perches(flight: Flight) -> list[tuple[float, TrajectoryOrder]]:
    """Return (time [s], order) of the planned perches."""
    return [(t, order) for t, order in flight.values("trajectory")
            if order.contact_after is not None and isinstance(order.trajectory, SampledTrajectory)]


def perching_errors(flight: Flight, scenario: Scenario, wire_offset: float) -> dict[str, float | None]:
    """Return the errors at the planned end of the perch, or at the gripper's closing if that is earlier.

    Args:
        flight: the flight.
        scenario: scenario with the true wires.
        wire_offset: distance of the centre of mass from the wire's axis at the end of the plan [m].

    Returns:
        `perching_position_m`: position error across the wire, true position relative to the true wire minus planned position
        relative to the planned wire; `perching_in_map_m`: true minus planned position in map, including the odometry's drift;
        `perching_tilt_deg`: angle between the true and the planned b3. None if the flight did not reach the perching point.
    """
    none: dict[str, float | None] = {"perching_position_m": None, "perching_in_map_m": None, "perching_tilt_deg": None}
    plans, truth = _perches(flight), flight.states("ground_truth/odometry")
    if not plans or truth is None:
        return none
    order = plans[-1][1]
    plan, perch_time = order.trajectory, order.contact_after
    assert isinstance(plan, SampledTrajectory) and perch_time is not None
    end = plan.start_time + perch_time
    touch = contact_of(flight)
    if touch is not None and touch[1].state == 3 and touch[0] < end:
        return none  # crashed on the way
    moment = touch[0] if touch is not None and plan.start_time < touch[0] < end else end
    if truth.t[-1] < moment:
        return none
    planned, last, true = plan.sample(moment - plan.start_time), plan.sample(perch_time), truth.at(np.array([moment]))
    b3 = so3.quat_to_matrix(planned.q)[:, 2]
    planned_wire = last.p - wire_offset * so3.quat_to_matrix(last.q)[:, 2]
    wire = CableLine(scenario.world.cables[_target(scenario)]).nearest(true.p[0])
    offset = (true.p[0] - wire.point_W) - (planned.p - planned_wire)
    offset -= (offset @ wire.direction) * wire.direction
    tilt = so3.angle_between(b3, so3.quat_to_matrix(true.q[0])[:, 2])
    return {"perching_position_m": float(np.linalg.norm(offset)), "perching_in_map_m": float(np.linalg.norm(true.p[0] - planned.p)),
            "perching_tilt_deg": math.degrees(tilt)}


def mapping_errors(flight: Flight, scenario: Scenario) -> dict[str, float | None]:
    """Return the mean distance of the mapped target wire from the true one within `MAP_RADIUS` of the target, at the request of the
    first plan.

    Returns:
        `mapping_in_map_m`: distance in map, including the odometry's drift; `mapping_m`: distance relative to the vehicle, the
        mapped wire seen from the estimated pose and the true wire from the true pose. None if there is no such map.
    """
    none: dict[str, float | None] = {"mapping_m": None, "mapping_in_map_m": None}
    plans = _perches(flight)
    truth, estimate = flight.states("ground_truth/odometry"), flight.states("odometry")
    lead = MISSION.lead(MISSION.powerline_latency)
    maps = [m for t, m in flight.values("powerlines") if plans and t <= plans[0][0] - lead and m.lines]
    if not maps or truth is None or estimate is None:
        return none
    point, cable = np.array(scenario.mission.perch_point), CableLine(scenario.world.cables[_target(scenario)])
    lines: list[Segment] = [line.segment for line in maps[-1].lines]
    samples = np.linspace(*min(lines, key=lambda line: float(line.distance(point))).ends, 400)
    samples = samples[np.linalg.norm(samples - point, axis=1) < MAP_RADIUS]
    if not len(samples):
        return none
    moment = np.array([seconds(maps[-1].stamp)])
    estimated, true = estimate.at(moment), truth.at(moment)
    turn = so3.quat_to_matrix(true.q[0]) @ so3.quat_to_matrix(estimated.q[0]).T
    aligned = true.p[0] + (samples - estimated.p[0]) @ turn.T
    return {"mapping_m": float(np.mean([cable.nearest(p).distance for p in aligned])),
            "mapping_in_map_m": float(np.mean([cable.nearest(p).distance for p in samples]))}


def hovers_at_end(flight: Flight) -> bool:
    """Return whether the true vehicle is slow, high enough and not held by a wire at the end."""
    truth = flight.states("ground_truth/odometry")
    held = any(c.state == ContactState.ATTACHED for _, c in flight.values("contact")[-1:])
    return truth is not None and not held and float(np.linalg.norm(truth.v[-1])) < MAX_HOVER_SPEED and float(truth.p[-1, 2]) > LEAST_HEIGHT


def recovered(run: RunResult) -> bool:
    """Return whether a flight that did not grip ended in a hover, in truth."""
    return run.outcome == "missed" and run.cause != "crash" and run.metrics.get("hovers_at_end") == 1.0


def flights(effort: Effort, cases: tuple[str, ...]) -> dict[tuple[str, bool], list[RunResult]]:
    """Return the flights by (case, whether the gripper works); finished flights of the same code are not repeated."""
    tasks = []
    jobs = [(seed, case, grips) for seed in effort.seeds_on_lines for grips in (True, False) for case in cases
            if grips or case in CASES_WITHOUT_GRIP and seed <= SEEDS_WITHOUT_GRIP]
    for number, (seed, case, grips) in enumerate(jobs):  # a flight keeps its number when seeds are added
        mapping: dict[str, Any] = extended_mapping("scenarios", case)
        if not grips:
            mapping["grip"] = mapping.get("grip", {}) | {"enabled": False}
        tasks.append(Task(Run(number, seed, {"scenario": case, "grips": grips}), mapping, ENGINE, RENDERED))
    found = cached_runs(effort, "line_flights", tasks, lambda r: r.cause == SUCCESS if r.values["grips"] else recovered(r))
    return {(case, grips): [r for r in found if r.values == {"scenario": case, "grips": grips}] for case in cases for grips in (True, False)}
