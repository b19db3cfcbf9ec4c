"""Selection of the components that fly a scenario, and the flight from the goal to its end."""

from __future__ import annotations

import time as clock
from collections.abc import Collection, Mapping
from contextlib import closing
from dataclasses import dataclass
from dataclasses import replace as replaced
from typing import Any

from perch_core.component import Component
from perch_core.config import choice
from perch_core.errors import PerchError
from perch_core.processes import without_collector
from perch_core.values import NANOSECONDS, seconds
from perch_eval.goal import goal_of, outcome_of
from perch_eval.in_process.loop import Loop
from perch_eval.in_process.modelled_sight import MapParameters, ModelledMap, modelled_target_localizer
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.in_process.trace import FlightTrace
from perch_perception.target_localizer import TargetLocalizerConfig
from perch_sim.drawing import OnDemandRendering
from perch_sim.lockstep import START, Task, flight_tasks
from perch_sim.parameters import CAMERAS, VehicleParameters
from perch_sim.scenario import Scenario
from perch_sim.simulated_vehicle import SimulatedVehicle

CANCEL_TIME = 15 * NANOSECONDS  # for a cancelled flight to come to its end [ns]
SENSING_OPTIONS = ("model", "rendered")
PLANNERS = {"surface": "perching_planner", "powerline": "powerline_planner"}


@dataclass(frozen=True)
class Sensing:
    """Choice per camera: `rendered` images, or `model`, an error model in place of the component that processes them."""

    vio: str = choice("model", options=SENSING_OPTIONS)
    target: str = choice("model", options=SENSING_OPTIONS)

    def __post_init__(self) -> None:
        for name in ("vio", "target"):
            if getattr(self, name) not in SENSING_OPTIONS:
                raise PerchError(f"sensing.{name}: {getattr(self, name)!r} is not one of {', '.join(SENSING_OPTIONS)}")


def arrange(scenario: Scenario, seed: int, sensing: Sensing = Sensing(), *, replace: Mapping[str, Component[Any]] | None = None,
            without: Collection[str] = (), script: Component[Any] | None = None) -> Loop:
    """Return the flight of a scenario before its first step.

    Args:
        scenario: scenario to be flown.
        seed: seed of all random draws; the same seed gives bit-identical flights.
        sensing: which cameras are rendered.
        replace: name -> component in place of the scenario's.
        without: names of components that are left out.
        script: component in place of the mission, executed at every step before the controller.

    Raises:
        ConfigError: the scenario or a node's parameter is invalid.
        PerchError: a cable sags and would need an error model, which does not exist.
    """
    parameters, replace = NodeParameters(scenario, seed), replace or {}
    surface = scenario.mode == "surface"
    localizer = "target_localizer" if surface else "powerline_mapper"
    left_out = {*without, *(("mission",) if script is not None else ())}
    names = [name for name in ("vio" if sensing.vio == "rendered" else "vio_model", "estimator", localizer, "controller", "mission")
             if name not in left_out]
    front = "target_localizer" in names or sensing.target == "rendered"  # its frames start work, whether or not they are drawn
    given = parameters.node_config("vehicle", VehicleParameters)
    rendered = {camera for camera, wanted in (("down", sensing.vio == "rendered"), ("front", front)) if wanted} & set(CAMERAS[given.cameras])
    cameras = next(name for name, members in CAMERAS.items() if set(members) == rendered)
    vehicle = SimulatedVehicle(replaced(given, cameras=cameras), scenario, OnDemandRendering)
    components = {}
    for name in names:
        if name in replace:
            components[name] = replace[name]
        elif name == "target_localizer" and sensing.target == "model":
            components[name] = modelled_target_localizer(parameters.node_config(name, TargetLocalizerConfig), vehicle, seed)
        elif name == "powerline_mapper" and sensing.target == "model":
            components[name] = ModelledMap(replaced(parameters.node_config(name, MapParameters), seed=seed), scenario)
        else:
            components[name] = parameters.component(name)
    planner = PLANNERS.get(scenario.mode)
    servers = {} if planner is None or planner in without else {planner: replace.get(planner) or parameters.component(planner)}
    tasks = flight_tasks(scenario.latency)
    if script is not None:
        components["script"] = script
        tasks = {"estimator": tasks["estimator"], "script": Task(), **tasks}
    return Loop(vehicle, components, tasks, servers)


def fly(scenario: Scenario, seed: int, sensing: Sensing = Sensing(), linger: float = 0.0) -> FlightTrace:
    """Fly a scenario once; arguments and errors as those of `arrange`, and `linger`: simulated time after the goal's end [s]."""
    return perch(arrange(scenario, seed, sensing), scenario, linger)


def perch(loop: Loop, scenario: Scenario, linger: float = 0.0) -> FlightTrace:
    """Fly an arranged flight from the scenario's goal to its end; arguments as those of `fly`."""
    began = clock.perf_counter()
    goal = loop.send("mission", goal_of(scenario))
    limit = START + round(scenario.time_limit * NANOSECONDS)
    stamp = 0
    with closing(loop), without_collector():  # a trace only grows: collecting garbage in it takes a tenth of a flight's time
        while goal.result is None and stamp < limit + CANCEL_TIME:
            stamp = loop.step()
            goal.cancel_requested = stamp > limit
        trace, result, timed_out = loop.trace, goal.result, goal.cancel_requested
        trace.end_time = seconds(stamp)
        goal.cancel_requested = False
        end = stamp + round(linger * NANOSECONDS)
        while stamp < end:
            stamp = loop.step()
    if result is None:
        trace.outcome, trace.message = "timeout", f"no end within {trace.end_time:.1f} s"
    else:
        trace.outcome, trace.message = outcome_of(result.error_code, scenario, timed_out), result.message
    trace.wall_time = clock.perf_counter() - began
    return trace
