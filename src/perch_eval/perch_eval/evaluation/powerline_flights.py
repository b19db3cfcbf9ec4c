"""[P] Table I, the flown half: perches on lines, cameras rendered, and their errors at the perching point."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import config, so3
from perch_core.ros.trajectories import from_message
from perch_core.trajectory import SampledTrajectory
from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task, fly_in_process
from perch_eval.campaign.progress import Progress
from perch_eval.campaign.results import Results, RunResult
from perch_eval.campaign.specification import Run
from perch_eval.campaign.workers import in_pool
from perch_eval.evaluation.sections import Effort
from perch_eval.flight import Flight
from perch_eval.metrics import touch_of

ENGINE = "perch_eval.evaluation.powerline_flights:fly_line"
RENDERED = {"vio": "rendered", "target": "rendered"}
SEEDS = range(1, 11)


def fly_line(task: Task) -> RunResult:
    """One perch on a line, the same as by the real nodes, with the errors at the perching point among its metrics."""
    result = fly_in_process(task)
    return dataclasses.replace(result, metrics=result.metrics | perching_errors(Flight(Path(task.keep) / "flight.mcap")))


def perching_errors(flight: Flight) -> dict[str, float | None]:
    """Distance [m] and angle between the b3 axes [deg] of truth and plan when the perch ends, or when the gripper closes."""
    none: dict[str, float | None] = {"perching_position_m": None, "perching_tilt_deg": None}
    plans = [m for _, m in flight.messages("trajectory") if m.at_end in (1, 3) and m.points]
    truth = flight.states("ground_truth/odometry")
    if not plans or truth is None:
        return none
    plan = from_message(plans[-1])
    if not isinstance(plan, SampledTrajectory):
        return none
    end = plan.start_time + (plans[-1].recovery_start if plans[-1].recovery_start > 0 else plan.duration)
    touch = touch_of(flight)
    moment = touch[0] if touch is not None and plan.start_time < touch[0] < end else end
    if truth.t[-1] < moment:
        return none
    wanted, true = plan.sample(moment - plan.start_time), truth.at(np.array([moment]))
    tilt = so3.angle_between(so3.quat_to_matrix(wanted.q)[:, 2], so3.quat_to_matrix(true.q[0])[:, 2])
    return {"perching_position_m": float(np.linalg.norm(true.p[0] - wanted.p)), "perching_tilt_deg": math.degrees(tilt)}


def flights(effort: Effort, cases: tuple[str, ...], digest: str) -> dict[str, list[RunResult]]:
    """Flights of each case; finished ones of the same code are not flown again."""
    effort.state.mkdir(parents=True, exist_ok=True)
    results = Results(effort.state / f"line_flights_{digest[:12]}.sqlite", "line flights", digest, resume=True)
    try:
        tasks = []
        for number, (seed, case) in enumerate((seed, case) for seed in SEEDS for case in cases):
            mapping: dict[str, Any] = config.read_yaml(config.find("scenarios", case))
            tasks.append(Task(Run(number, seed, {"scenario": case}), mapping, ENGINE, RENDERED,
                              str((effort.state / "lines" / f"{case}_{seed}").absolute())))
        known = {r.number for r in results.all()}
        progress = Progress(len(tasks), len(known), what="line flights")
        for result in in_pool([t for t in tasks if t.run.number not in known], 1):
            results.add(result)
            progress.add(result.cause == SUCCESS)
        progress.close()
        found = results.all()
    finally:
        results.close()
    return {case: [r for r in found if r.values["scenario"] == case] for case in cases}
