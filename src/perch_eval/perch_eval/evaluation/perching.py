"""[M] Tables II and III, Fig. 5 and 6: perching flights with rendered cameras and the complete software."""

from __future__ import annotations

import math
import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
import yaml

from perch_core.extends import extended_mapping
from perch_core.vehicle import load_vehicle
from perch_eval import plots
from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Run
from perch_eval.evaluation import consistency
from perch_eval.evaluation.consistency import SENSING
from perch_eval.evaluation.kept import cached_runs
from perch_eval.evaluation.document import Effort, Section
from perch_eval.flight_view import FlightView
from perch_eval.in_process import fly
from perch_eval.statistics import Rate, Spread
from perch_sim.scenario import load_scenario

CONDITIONS = {"surface_60": (60, 1.7), "surface_90": (90, 1.7), "surface_60_far": (60, 3.0), "surface_90_far": (90, 3.0)}
"""Scenario -> inclination [deg] and distance [m]."""
AGGRESSIVE = "surface_90_aggressive"
"""Scenario for the body rates of Fig. 6."""

SUCCESSES = {"surface_60": 4, "surface_90": 4, "surface_60_far": 3, "surface_90_far": 4}  # of 5
REQUIRED_RATES = {"surface_60": 0.95, "surface_90": 0.95, "surface_60_far": 0.90, "surface_90_far": 0.90}  # with 100 seeds
# x, y, z [m]: (tracking, estimation)
RMSE = {"surface_60": ((0.0500, 0.0325, 0.1509), (0.0145, 0.0851, 0.0714)),
        "surface_60_far": ((0.0378, 0.0732, 0.1321), (0.0401, 0.0714, 0.0452)),
        "surface_90": ((0.0503, 0.0539, 0.1081), (0.0314, 0.0533, 0.0405)),
        "surface_90_far": ((0.0948, 0.0360, 0.0911), (0.0660, 0.0045, 0.0485))}
PEAK_RATE, PEAK_ACCELERATION = 600.0, 10.0  # [deg/s], [m/s^2]


def perching_sections(effort: Effort) -> list[Section]:
    """Return Tables II and III, Fig. 5 and 6, and the comparison of the in-process engine with the real nodes."""
    groups = perches(effort)
    return [_errors(effort, groups), _successes(effort, groups), *_figures(effort, groups), _engines()]


def perches(effort: Effort) -> dict[str, list[RunResult]]:
    """Return the flights of each condition; finished flights of the same code are not repeated, and those of `consistency` are shared."""
    names = (*CONDITIONS, AGGRESSIVE)
    jobs = enumerate(product(effort.seeds, (name for name in names if name != consistency.SCENARIO)))
    found = cached_runs(effort, "flights", [Task(Run(number, seed, {"scenario": name}), extended_mapping("scenarios", name), "in_process", SENSING)
                                      for number, (seed, name) in jobs])
    shared = [run for run, _ in consistency.judged_flights(effort, effort.seeds)]
    return {name: shared if name == consistency.SCENARIO else [r for r in found if r.values["scenario"] == name] for name in names}


def _condition_text(name: str) -> str:
    inclination, distance = CONDITIONS[name]
    return f"{inclination} deg, {distance:g} m"


def _seeds_text(effort: Effort) -> str:
    return f"seeds {effort.seeds.start} to {effort.seeds.stop - 1}"


def _errors(effort: Effort, groups: dict[str, list[RunResult]]) -> Section:
    out = Section("m_table_2", "[M] Table II: tracking and estimation RMSE",
                  f"Per axis over the perch, from its planned start to the contact; median [range] over {_seeds_text(effort)}, of all "
                  "flights with a planned perch. Both cameras are rendered; VIO, UKF, tag localisation, planner and controller are those that fly.")
    for name, paper in RMSE.items():
        for kind, values in zip(("tracking", "estimation"), paper):
            flights = [[r.metrics.get(f"{kind}_rmse_m_{axis}") for axis in "xyz"] for r in groups[name]]
            for axis, value, *errors in zip("xyz", values, *flights):
                spread = Spread.from_values(errors)
                out.compare(f"{_condition_text(name)}: {kind} {axis}", f"{spread.to_text(100, 1, 'cm')} ({spread.count} of {len(errors)} flights)",
                            f"{100 * value:.2f} cm", spread.median <= value)
                out.data[f"{name}_{kind}_{axis}"] = errors
            together = Spread.from_values(float(np.linalg.norm(np.array(errors, float))) for errors in flights)
            theirs = math.hypot(*values)
            out.claim(f"{_condition_text(name)}: {kind}, all axes", f"{together.to_text(100, 1, 'cm')} ({together.count} of {len(flights)} flights)",
                      f"{100 * theirs:.1f} cm", together.median <= theirs and together.count == len(flights),
                      "median of the flights' roots of the sum of squares is at most the paper's; every flight begins its perch")
    return out


def _successes(effort: Effort, groups: dict[str, list[RunResult]]) -> Section:
    out = Section("m_table_3", "[M] Table III: success rate",
                  f"{_seeds_text(effort).capitalize()}; a success: the vehicle is attached to the pad at the end, and the mission reports it. "
                  "95 % Wilson intervals; a required rate that as many flights would not show if all succeeded is vacuous (95 %: below 73 flights).")
    for name, paper in SUCCESSES.items():
        rate = Rate.from_outcomes(r.cause == SUCCESS for r in groups[name])
        bar = REQUIRED_RATES[name] if effort.full else paper / 5
        why = f"at least {100 * bar:.0f} %" + ("" if effort.full else ", the paper's rate")
        causes = ", ".join(f"seed {r.seed}: {r.cause}" for r in groups[name] if r.cause != SUCCESS)
        out.claim(_condition_text(name), str(rate), f"{paper}/5", rate.at_least(bar),
                  why + (f"; failed: {causes}" if causes else ""))
        out.data[name] = {"successes": rate.successes, "trials": rate.trials, "interval": rate.interval,
                          "failed": {str(r.seed): [r.cause, r.message] for r in groups[name] if r.cause != SUCCESS}}
    return out


def _figures(effort: Effort, groups: dict[str, list[RunResult]]) -> list[Section]:
    """Return Fig. 5 and 6 from seed 1 at 90 deg, 1.7 m, and the values of all seeds beside the paper's."""
    five = Section("m_fig_5", "[M] Fig. 5: tracking, localisation and thrust at 90 deg, 1.7 m", "Seed 1; truth, estimate and reference.")
    six = Section("m_fig_6", "[M] Fig. 6: body rates at 90 deg, 1.7 m", f"The figure shows seed 1, the rows {_seeds_text(effort)}.")
    scenario = load_scenario("surface_90")
    trace = fly(scenario, 1, SENSING, linger=0.5)
    view = FlightView.from_flight(trace.flight, load_vehicle(scenario.vehicle))
    for section, name, figure, caption in (
            (five, "m_fig_5_tracking.png", plots.tracking_figure(view), "Position and velocity over time"),
            (five, "m_fig_5_path.png", plots.path_figure(view), "Path from the side with b3 as arrows"),
            (five, "m_fig_5_thrust.png", plots.thrust_figure(view), "Thrust against its bounds"),
            (six, "m_fig_6.png", plots.rates_figure(view), "Body rates and tilt")):
        figure.savefig(effort.out / name, dpi=95)
        section.figures.append((name, caption))
    five.show("outcome of seed 1", ": ".join(dict.fromkeys((trace.outcome, trace.message))))
    contact = [c for c in trace.contacts if c.body == "pad"]
    if contact:
        five.show("contact of seed 1", f"{contact[0].normal_speed:.2f} m/s along, {contact[0].tangential_speed:.2f} m/s across, tilt error "
                  f"{math.degrees(contact[0].tilt_error):.1f} deg", "0.4-0.6 m/s planned")
    rates, fast = (Spread.from_values(r.metrics.get("max_body_rate_deg_s") for r in groups[name]) for name in ("surface_90", AGGRESSIVE))
    peaks = Spread.from_values(r.metrics.get("max_acceleration_m_s2") for r in groups["surface_90"])
    impact = extended_mapping("scenarios", AGGRESSIVE)["parameters"]["perching_planner"]["impact_acceleration"]
    six.compare("largest body rate, `surface_90`", rates.to_text(1.0, 0, "deg/s"), f"close to {PEAK_RATE:g} deg/s", rates.median >= PEAK_RATE,
                "like for like: 90 deg, 1.7 m, the paper's impact acceleration")
    six.claim(f"largest body rate, `{AGGRESSIVE}`", fast.to_text(1.0, 0, "deg/s"), f"close to {PEAK_RATE:g} deg/s",
              0.9 * PEAK_RATE <= fast.median <= 1.1 * PEAK_RATE if groups[AGGRESSIVE] else None,
              f"within 10 % of the paper's; this scenario's impact acceleration, {impact:g} m/s^2, was chosen to reach the rate")
    held = Rate.from_outcomes(r.cause == SUCCESS for r in groups[AGGRESSIVE])
    six.claim(f"perches, `{AGGRESSIVE}`", str(held), "", held.at_least(0.95), "at least 95 %")
    six.claim("largest acceleration", peaks.to_text(1.0, 1, "m/s^2"), f"up to {PEAK_ACCELERATION:g} m/s^2", peaks.median >= 0.7 * PEAK_ACCELERATION,
              "at least 70 % of the paper's")
    return [five, six]


def _engines() -> Section:
    """Compare one flight on the real nodes with the same flight in process."""
    from perch_eval.demo import fly as fly_on_the_stack
    from perch_eval.nodes import ALL_NODES
    from perch_eval.ros.recorded_flight import RecordedFlight

    out = Section("engines", "In process and over ROS: the same flight",
                  "surface_90, seed 1, cameras rendered: once on the real ROS 2 nodes (composed, in lockstep), once on the in-process engine "
                  "that flies the tables above.")
    mapping = {**extended_mapping("scenarios", "surface_90"),
               "nodes": ["vehicle", "vio", "estimator", "target_localizer", "perching_planner", "controller", "mission"]}
    with tempfile.TemporaryDirectory(prefix="perch-evaluate-") as folder:
        file = Path(folder) / "surface_90.yaml"
        file.write_text(yaml.safe_dump(mapping))
        try:
            report = fly_on_the_stack(str(file), 1, Path(folder) / "stack", composed=ALL_NODES)
            states = RecordedFlight(Path(folder) / "stack" / "flight.mcap").states("ground_truth/odometry")
        except Exception as error:  # without ROS, or with a node missing, the tables still stand
            out.missing("greatest difference of position", "", f"the stack did not fly: {error}")
            return out
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:  # loads the same sources as the nodes
            trace = pool.submit(fly, load_scenario(file), 1, SENSING).result()
    rows = trace.flight.known_states("ground_truth/odometry")
    if states is None or len(states.t) < len(rows.t):
        out.claim("greatest difference of position", f"{0 if states is None else len(states.t)} of {len(rows.t)} steps on the stack "
                  f"({report['outcome']})", "", False, "the same flight")
        return out
    worst = float(np.abs(states.p[:len(rows.t)] - rows.p).max())
    out.claim("greatest difference of position", f"{worst:.1e} m over {len(rows.t)} steps", "", worst < 1e-7, "below 1e-7 m")
    out.show("outcome", f"{report['outcome']} on the stack, {trace.outcome} in process")
    return out
