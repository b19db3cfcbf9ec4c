"""What comes to each component in a flight, in order: the valid streams between which nonsense is sent."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from perch_core.component import Action, Client, Component, Input, Service, Timer, ports
from perch_core.values import CameraImage
from perch_eval.goal import goal_of
from perch_eval.in_process.flights import Sensing, arrange
from perch_eval.in_process.loop import SentGoal
from perch_eval.in_process.parameters import NodeParameters
from perch_sim.drawing import OnDemandRendering
from perch_sim.parameters import VehicleParameters
from perch_sim.scenario import Scenario, load_scenario
from perch_sim.simulated_vehicle import SimulatedVehicle
from perch_sim.timing import CONTROL_PERIOD

SEED = 1
LONGEST = 20.0  # of a flight [s]
RENDERED = 2.5  # the same with images [s]


class Event(NamedTuple):
    """One call of a component: the name of its method, and what it gets."""

    method: str
    arguments: tuple[Any, ...]


FLIGHTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "surface": ("surface_90", ("vio_model", "estimator", "controller", "mission", "vehicle", "description")),
    "line": ("line_80", ("estimator", "controller", "mission")),
    "images": ("surface_60", ("vio", "target_localizer")),
    "lines": ("line_80", ("powerline_mapper",)),
}
"""Flight -> its scenario, and the components whose inputs are of it; those with images are drawn."""


def is_rendered(flight: str) -> bool:
    """Whether a flight has images."""
    return flight in ("images", "lines")


@lru_cache(maxsize=None)
def scenario_of(flight: str) -> Scenario:
    """The scenario of a flight."""
    return load_scenario(FLIGHTS[flight][0])


def component(flight: str, name: str) -> Component[Any]:
    """A component as it begins a flight."""
    scenario = scenario_of(flight)
    if name == "vehicle":
        return SimulatedVehicle(VehicleParameters(seed=SEED, cameras="none"), scenario, OnDemandRendering)
    made = NodeParameters(scenario, SEED).component(name)
    made.warm_up()
    for port in ports(type(made), Client):
        setattr(made, port.name, lambda request, due: None)  # answers are of the stream
    return made


@lru_cache(maxsize=None)
def recorded(flight: str) -> dict[str, tuple[Event, ...]]:
    """The events of each component of a flight."""
    scenario, names = scenario_of(flight), FLIGHTS[flight][1]
    events: dict[str, list[Event]] = {name: [] for name in names}
    parameters = NodeParameters(scenario, SEED)
    taken = {name: parameters.component(name) for name in names if name not in ("vehicle", "description")}
    for name, one in taken.items():
        _tap(one, events[name])
    rendered = is_rendered(flight)
    sensing = Sensing("rendered" if "vio" in taken else "model", "rendered" if rendered else "model")
    loop = arrange(scenario, SEED, sensing, replace=taken)
    if "vehicle" in events:
        loop.components["controller"].motor_command.receivers.append(lambda value: events["vehicle"].append(Event("on_motor_command", (value,))))
    goal = loop.send("mission", goal_of(scenario))
    for _ in range(round((RENDERED if rendered else LONGEST) / CONTROL_PERIOD)):
        if goal.result is not None:
            break
        if "vehicle" in events:
            events["vehicle"].append(Event("advance", ()))
        loop.step()
    loop.close()
    if "description" in events:
        events["description"] = [Event("on_start", (0,)), *(e for e in events["mission"] if e.method in ("on_odometry", "on_target"))]
    return {name: tuple(some) for name, some in events.items()}


def _tap(one: Component[Any], events: list[Event]) -> None:
    """Keep what comes to a component."""
    kinds = (Input, Timer, Service, Client, Action)
    for port in (port for kind in kinds for port in ports(type(one), kind)):
        method = f"on_{port.name}"

        def taken(*arguments: Any, method: str = method, work: Any = getattr(one, method)) -> Any:
            events.append(Event(method, tuple(map(_kept, arguments))))
            return work(*arguments)

        setattr(one, method, taken)


def _kept(argument: Any) -> Any:
    """An argument that can be handed over again: images are drawn, goals are what was asked for."""
    if isinstance(argument, SentGoal):
        return argument.value
    if callable(argument):
        return _forget
    if isinstance(argument, CameraImage):
        return CameraImage(argument.stamp, argument.frame, argument.width, argument.height, argument.encoding, np.array(argument.pixels()))
    return argument


def _forget(answer: Any) -> None:
    """Nobody waits for this answer."""
