"""[P] Table I and Fig. 6-8: plans of perches on powerlines, planning times, and flown perches with rendered cameras and their errors."""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import numpy as np

from perch_core import so3
from perch_core.errors import PerchError, PlanningRefusal
from perch_core.extends import extended_mapping
from perch_core.lines import Segment
from perch_core.trajectory import SampledTrajectory
from perch_core.values import TrajectoryOrder, seconds
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task, fly_in_process
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Run
from perch_eval.ending import MAX_HOVER_SPEED
from perch_eval.evaluation.document import Effort, Section
from perch_eval.evaluation.kept import cached_runs
from perch_eval.flight import Flight
from perch_eval.in_process import Sensing
from perch_eval.metrics import MISSION, contact_of
from perch_eval.statistics import Rate, Spread
from perch_planner.powerline import problem
from perch_planner.powerline.picture import draw_manoeuvre, draw_visibility
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.starts import random_start
from perch_planner.powerline.visibility import visibility
from perch_sim.cable_contact import CableLine
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario

# case -> (position RMSE [cm], pitch-roll RMSE [deg], perch [ms], recovery [ms])
TABLE = {"line_80": (3.1, 2.0, 432, 221), "line_80_pa": (3.4, 2.6, 1526, 584), "line_20": (2.7, 2.1, 457, 351),
         "line_20_pa": (4.8, 7.2, 1893, 461), "line_180": (6.9, 3.0, 532, 1214)}
TITLES = {"line_80": "80 deg", "line_80_pa": "80 deg, perception-aware", "line_20": "20 deg", "line_20_pa": "20 deg, perception-aware",
         "line_180": "180 deg"}
POSITION = "position RMSE, true against planned place"
PUBLISHED = {"deg90_published": 1.861, "upside_down_published": 2.485}  # durations of the authors' own trajectories [s]
PUBLISHED_TOLERANCE = 1e-3  # of the duration of a plan of the same problem [s]
ENGINE = "perch_eval.evaluation.powerline:fly_line"
RENDERED = Sensing(vio="rendered", target="rendered")
CASES_WITHOUT_GRIP = ("line_80", "line_20", "line_180")  # also flown with a gripper that never closes: all must recover
SEEDS_WITHOUT_GRIP = 3
LEAST_HEIGHT = 0.8  # of a hover at the end [m]
MAP_RADIUS = 1.5  # around the target point within which the map is judged [m]


def powerline_sections(effort: Effort) -> list[Section]:
    """Return the planning times of Table I, the published problems, and Fig. 6-8."""
    return [_table(effort), _published(), *_pictures(effort)]


def _table(effort: Effort) -> Section:
    count = 50 if effort.full else 5
    out = Section("p_table_1", "[P] Table I: planning time of perch and recovery",
                  f"{count} random starts around the nominal one for each row (generator seeds 1 to {count}); median [range] of the "
                  "solver's wall-clock time on this machine, compiled functions loaded. Each plan is re-integrated at 1 ms; one "
                  "that violates a limit there is refused. The paper: 5 experiments on a Jetson TX2.")
    vehicle = load_vehicle("rpg")
    planner = PowerlinePlanner(vehicle)
    planner.warm_up()
    for case, (_, _, paper_perch, paper_recovery) in TABLE.items():
        setup = problem.load(f"powerline_{case}")
        nominal = setup.request(vehicle)
        perch, recovery, refused = [], [], []
        for seed in range(1, count + 1):
            try:
                plan = planner.plan(random_start(nominal, setup, vehicle, np.random.default_rng(seed)))
            except PlanningRefusal as refusal:
                refused.append(f"seed {seed}: {refusal}")
                continue
            if plan.perch is None or plan.recovery is None:
                refused.append(f"seed {seed}: {plan.without_recovery}")
                continue
            perch.append(plan.perch.solve_time)
            recovery.append(plan.recovery.solve_time)
        out.data[case] = {"perch_s": perch, "recovery_s": recovery, "refused": refused}
        for name, values, paper in (("perch", perch, paper_perch), ("recovery", recovery, paper_recovery)):
            spread = Spread.from_values(1e3 * v for v in values)
            out.claim(f"{TITLES[case]}: {name}", spread.to_text(1.0, 0, "ms"), f"{paper} ms", spread.median <= paper,
                      "median at most the paper's")
        out.claim(f"{TITLES[case]}: starts solved", f"{len(perch)}/{count}", "", len(perch) == count, "; ".join(("all", *refused)))
    return out


def flown_sections(effort: Effort) -> list[Section]:
    """Return the errors of the flown perches at the perching point."""
    seeds = effort.seeds_on_lines
    flown = "seed 1" if len(seeds) == 1 else f"seeds 1 to {seeds[-1]}"
    out = Section("p_table_1_flown", "[P] Table I: errors at the perching point",
                  "In-process engine: what the nodes fly, to the last bit; both cameras rendered, cables mapped by the front one; "
                  f"{flown}; when the gripper closes, or where it should have. Position: RMSE of the body's true "
                  "place from the planned one in map, all axes, as tracked in the paper; ours includes the odometry's drift. Across the wire: "
                  "the true place against the true wire from the planned place against the planned one; the drift, which moves plan and wire "
                  "together, does not count. Mapping: mean distance of the mapped wire from the true one "
                  f"within {MAP_RADIUS:g} m of the target point when the perch is planned, both relative to the vehicle (in map: with the drift). "
                  f"Some scenarios are flown with the grip switched off as well (seeds up to {min(SEEDS_WITHOUT_GRIP, seeds[-1])}): each ends in a recovery. "
                  "The paper: an optical tracking system instead of VIO and mapping, no gripper, 5 flights each.")
    found = flights(effort, tuple(TABLE))
    for case, (paper_p, paper_q, *_) in TABLE.items():
        runs, name = found[case, True], TITLES[case]
        missed = [r for r in runs if r.cause != SUCCESS]
        words = "; ".join(f"seed {r.seed}: {r.cause}: {r.message}" for r in missed)
        out.show(f"{name}: gripped the cable", str(Rate.from_outcomes(r.cause == SUCCESS for r in runs)), "", words)
        for title, key, paper, factor, unit in ((POSITION, "perching_in_map_m", paper_p, 100.0, "cm"),
                                                ("pitch-roll RMSE", "perching_tilt_deg", paper_q, 1.0, "deg")):
            values = [value for r in runs if (value := r.metrics.get(key)) is not None]
            if runs:
                rmse = factor * float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")
                out.claim(f"{name}: {title}", f"{rmse:.1f} {unit} ({len(values)} of {len(runs)} flights)", f"{paper} {unit}",
                          rmse <= paper and len(values) == len(runs), "at most the paper's, all flights get there")
            else:
                out.missing(f"{name}: {title}", f"{paper} {unit}", "no flight")
        for title, key in (("position across the wire, without drift", "perching_position_m"), ("mapping in map", "mapping_in_map_m")):
            out.show(f"{name}: {title}", Spread.from_values(r.metrics.get(key) for r in runs).to_text(100.0, 1, "cm"))
        mapped = [value for r in runs if (value := r.metrics.get("mapping_m")) is not None]
        error = 100.0 * float(np.mean(mapped)) if mapped else float("nan")
        out.claim(f"{name}: mapping", f"{error:.1f} cm ({len(mapped)} of {len(runs)} flights)", "",
                  error <= 3.0 and len(mapped) == len(runs) if runs else None, "at most 3 cm in the mean, every flight plans on a map")
        hovering = sum(map(recovered, missed))
        out.claim(f"{name}: recoveries to a hover", f"{hovering} of {len(missed)}", "", hovering == len(missed) if missed else None, "all that did not grip")
        without_grip = found[case, False]
        if without_grip:
            words = "; ".join(f"seed {r.seed}: {r.cause}: {r.message}" for r in without_grip if not recovered(r))
            out.claim(f"{name}, grip switched off: recoveries to a hover", f"{sum(map(recovered, without_grip))} of {len(without_grip)}", "",
                      not words, words or "all")
        touched = [value for r in runs + without_grip if (value := r.metrics.get("other_lines_touched")) is not None]
        count = len(runs + without_grip)
        out.claim(f"{name}: contacts with other lines", f"{sum(touched):.0f} ({len(touched)} of {count} flights)", "",
                  sum(touched) == 0 and len(touched) == count if count else None, "none, every flight is carried out")
        out.data[case] = [{"seed": r.seed, "grips": r.values["grips"], "cause": r.cause, "outcome": r.outcome, "message": r.message, **r.metrics}
                          for r in runs + without_grip]
    return [out]


def _published() -> Section:
    out = Section("p_published", "[P] The authors' published trajectories",
                  "The authors' costs, vehicle and limits in our formulation; their trajectories are the reference. Without noise: no seed.")
    claim = f"the same to {1e3 * PUBLISHED_TOLERANCE:g} ms"
    for name, paper in PUBLISHED.items():
        began = perf_counter()
        try:
            planned = problem.plan(problem.load(f"powerline_{name}"))
        except PerchError as error:
            out.claim(f"duration of {name}", f"refused: {error}", f"{paper:.3f} s", False, claim)
            continue
        if planned.plan.perch is None:
            out.claim(f"duration of {name}", "no perch", f"{paper:.3f} s", False, claim)
            continue
        ours = planned.plan.perch.duration
        out.claim(f"duration of {name}", f"{ours:.4f} s", f"{paper:.3f} s", abs(ours - paper) <= PUBLISHED_TOLERANCE, claim)
        out.data[name] = {"duration_s": ours, "wall_s": perf_counter() - began}
    return out


def _pictures(effort: Effort) -> list[Section]:
    """Return Fig. 6 and 7 (80 deg without and with perception awareness) and Fig. 8 (upside down), as planned."""
    seven = Section("p_fig_6_7", "[P] Fig. 6 and 7: the line in view at 80 deg",
                    "As planned from the nominal start; not flown. A line beyond the image's corners, or behind the camera, counts as at them.")
    eight = Section("p_fig_8", "[P] Fig. 8: perching upside down", "As planned from the nominal start; not flown.")
    means = {}
    for case, section in (("line_80", seven), ("line_80_pa", seven), ("line_180", eight)):
        planned = problem.plan(problem.load(f"powerline_{case}"))
        if planned.plan.perch is None:
            raise PlanningRefusal("solver", "perch", -1.0, f"no perch of {case}")
        draw_manoeuvre(planned, effort.out / f"p_{case}.png")
        section.figures.append((f"p_{case}.png", f"{TITLES[case]}. Ellipse: body; short line: thrust; green: camera axis; dotted: lowest height allowed"))
        if section is seven:
            draw_visibility(planned, effort.out / f"p_{case}_visibility.png")
            section.figures.append((f"p_{case}_visibility.png", f"{TITLES[case]}: reprojection error and visibility"))
            mount = planned.vehicle.mounts[planned.problem.settings.camera]
            measures = visibility(planned.plan.perch.states, planned.request.target(), mount)
            means[case] = measures.summary()
            section.show(f"{TITLES[case]}: mean reprojection error", f"{means[case]['mean_reprojection_px']:.0f} px")
            for name, key in (("a part of the line in the image", "seen_share"), ("nearest point on the segment (14i)", "segment_share")):
                section.show(f"{TITLES[case]}: {name}", f"{100 * means[case][key]:.0f} % of the time")
        else:
            low = next(b for b in planned.plan.bounds if b.quantity == "height")
            section.show("lowest height of the perch", f"{low.minimum:.3f} m", ">= 0.8 m", "a plan that violates a limit at 1 ms is refused")
    seven.claim("perception awareness lowers the reprojection error",
                f"{means['line_80']['mean_reprojection_px']:.0f} -> {means['line_80_pa']['mean_reprojection_px']:.0f} px", "lower",
                means["line_80_pa"]["mean_reprojection_px"] < means["line_80"]["mean_reprojection_px"], "as in Fig. 7")
    seven.data = means
    return [seven, eight]


def fly_line(task: Task) -> RunResult:
    """Fly one perch on a line, as with the real nodes; its metrics include the errors at the perching point."""
    def errors(flight: Flight, scenario: Scenario, vehicle: Vehicle) -> dict[str, float | None]:
        return {**perching_errors(flight, scenario, vehicle.wire_offset), **mapping_errors(flight, scenario),
                "other_lines_touched": float(_others_touched(flight, scenario)), "hovers_at_end": float(hovers_at_end(flight))}

    return fly_in_process(task, errors, linger=0.5)


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
