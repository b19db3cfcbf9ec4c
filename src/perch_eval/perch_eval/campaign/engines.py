"""Engines that carry out one run: in process, on the real nodes, or a user-defined function (`module:function`)."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import yaml

from perch_core import config
from perch_core.errors import PerchError
from perch_core.processes import single_threaded_blas
from perch_core.registry import resolved
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.campaign.causes import ERROR, cause_of
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Campaign, Run
from perch_eval.flight import Flight
from perch_eval.in_process import Sensing, fly
from perch_eval.metrics import figures, flight_metrics
from perch_sim.scenario import Scenario


@dataclass(frozen=True)
class Task:
    """One run, ready to be sent to a worker.

    Attributes:
        run: number, seed and varied values.
        scenario: the scenario's mapping.
        engine: name of the engine.
        sensing: cameras that the in-process engine renders.
        report_folder: folder for the flight's recording and report; empty: neither is kept.
    """

    run: Run
    scenario: dict[str, Any]
    engine: str
    sensing: Sensing
    report_folder: str = ""

    @classmethod
    def from_campaign(cls, campaign: Campaign, run: Run, report_folder: str = "") -> Task:
        """Create the task of a campaign's run."""
        return cls(run, campaign.mapping(run), campaign.engine, campaign.sensing, report_folder)


def resolve(name: str) -> Callable[[Task], RunResult]:
    """Return the engine with a name.

    Raises:
        PerchError: there is no such engine.
    """
    if name not in ENGINES and ":" not in name:
        raise PerchError(f"engine {name!r} is not one of {', '.join(ENGINES)}, nor of the form module:function")
    try:
        return ENGINES.get(name) or resolved(name)
    except (ImportError, AttributeError) as error:
        raise PerchError(f"engine {name!r}: {error}") from None


def source_digest(name: str) -> str:
    """SHA-256 of the file of an own engine, which need not be part of this repository; empty for the engines that are."""
    file = None if name in ENGINES else getattr(import_module(name.partition(":")[0]), "__file__", None)
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""


def run_task(task: Task) -> RunResult:
    """Fly one run; an exception becomes a result with the cause `error`, which does not count when the campaign resumes."""
    began = time.perf_counter()
    single_threaded_blas()
    cv2.setNumThreads(1)  # runs share the cores already; OpenCV's own threads cost each of them 15 % more CPU time
    try:
        result = resolve(task.engine)(task)
    except Exception as error:  # one run that breaks must not end the campaign; its message is in the results
        result = RunResult(task.run.number, task.run.seed, ERROR, "failed", f"{type(error).__name__}: {error}")
    return dataclasses.replace(result, values=task.run.values, wall_time=time.perf_counter() - began)


Measure = Callable[[Flight, Scenario, Vehicle], dict[str, float | None]]


def fly_in_process(task: Task, measure: Measure = lambda *_: {}, linger: float = 0.0) -> RunResult:
    """Fly one run in this process.

    Args:
        task: run to be flown.
        measure: function that computes further figures of the flight.
        linger: simulated time after the goal's end [s]; 0.5 s where the flight is kept.
    """
    scenario = config.from_mapping(Scenario, task.scenario, f"run {task.run.number}")
    trace = fly(scenario, task.run.seed, task.sensing, 0.5 if task.report_folder else linger)
    vehicle = load_vehicle(scenario.vehicle)
    metrics = figures(flight_metrics(trace.flight, trace.end_time), trace.end_time)
    if task.report_folder:
        from perch_eval.report import build_report  # and with it matplotlib and ROS: most workers write no report
        from perch_eval.ros.recorded_flight import write

        folder = Path(task.report_folder)
        folder.mkdir(parents=True, exist_ok=True)
        write(folder / "flight.mcap", trace.timeline())
        (folder / "scenario.yaml").write_text(yaml.safe_dump(task.scenario))
        build_report(folder, scenario, task.run.seed, trace.outcome, trace.message, trace.wall_time, trace.end_time)
    return RunResult(task.run.number, task.run.seed, cause_of(trace.outcome, trace.contacts, scenario),
                     trace.outcome, trace.message, metrics=metrics | measure(trace.flight, scenario, vehicle))


def fly_on_the_stack(task: Task) -> RunResult:
    """Fly one run on the real nodes: composed, in lockstep, in a separate ROS domain."""
    from perch_eval.demo import fly
    from perch_eval.nodes import ALL_NODES

    with contextlib.ExitStack() as stack:
        folder = Path(task.report_folder or stack.enter_context(tempfile.TemporaryDirectory(prefix="perch-run-")))
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / "scenario.yaml"
        file.write_text(yaml.safe_dump(task.scenario))
        log = stack.enter_context(open(folder / "flight.log", "w"))
        with contextlib.redirect_stdout(log):
            report = fly(str(file), task.run.seed, folder, composed=ALL_NODES)
    return RunResult(task.run.number, task.run.seed, report["cause"], report["outcome"], report["message"],
                     metrics=figures(report, report["simulated_time_s"]))


ENGINES: dict[str, Callable[[Task], RunResult]] = {"in_process": fly_in_process, "stack": fly_on_the_stack}
