"""The components of a scenario with their parameters, from the same sources as the real nodes'."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, TypeVar

from perch_core import config
from perch_core.component import Component
from perch_core.errors import ConfigError
from perch_core.registry import resolved
from perch_eval.node_launch import node_launches
from perch_perception.estimators import estimator_class
from perch_sim.scenario import Scenario

T = TypeVar("T")

COMPONENTS = {
    "vehicle": "perch_sim.simulated_vehicle:SimulatedVehicle",
    "vio_model": "perch_sim.modelled_vio:ModelledVio",
    "vio": "perch_perception.vio_component:VioComponent",
    "estimator": "perch_perception.estimator_component:StateEstimator",
    "target_localizer": "perch_perception.target_localizer:TargetLocalizer",
    "powerline_mapper": "perch_perception.powerline_mapper:PowerlineMapper",
    "perching_planner": "perch_planner.perching_planner:PerchingPlanner",
    "powerline_planner": "perch_planner.powerline_planner:PowerlinePlannerComponent",
    "controller": "perch_control.controller:Controller",
    "mission": "perch_control.mission_component:Mission",
    "description": "perch_core.description:Description",
    "recorder": "perch_eval.ros.recorder:Recorder",
    "viewer": "perch_eval.ros.viewer:Viewer",
}
"""Node -> its component."""


def component_class(node: str, parameters: Mapping[str, Any]) -> type[Component[Any]]:
    """The component of a node, which its parameters may choose.

    Raises:
        ConfigError: there is none.
    """
    if node == "estimator" and "type" in parameters:
        return estimator_class(parameters["type"])
    return resolved(COMPONENTS[node])


class NodeParameters:
    """What `config/<node>.yaml`, the scenario and its `parameters` say for each node.

    Attributes:
        given: node -> its parameters by dotted name.
    """

    def __init__(self, scenario: Scenario, seed: int, nodes: Collection[str] = tuple(COMPONENTS)) -> None:
        """
        Args:
            scenario: what is flown.
            seed: of the flight.
            nodes: those that are asked for.

        Raises:
            ConfigError: a parameter file is none.
        """
        # The scenario may name parameters of either VIO; both are read, one is flown.
        self.given = {launch.name: launch.parameters for launch in node_launches(scenario, tuple(nodes), seed=seed)}

    def of(self, node: str, cls: type[T]) -> T:
        """The parameters of a node.

        Raises:
            ConfigError: one of them is unknown, of the wrong type, or out of range.
        """
        return config.from_mapping(cls, config.nested(self.given[node]), node)  # type: ignore[type-var]

    def component(self, node: str) -> Component[Any]:
        """The component of a node with its parameters.

        Raises:
            ConfigError: a parameter is refused.
        """
        cls = component_class(node, self.given[node])
        return cls(self.of(node, cls.config_type))


def check_parameters(scenario: Scenario, source: str) -> None:
    """Make sure that every node takes what the scenario sets for it.

    Raises:
        ConfigError: with the parameter's place in the scenario.
    """
    parameters = NodeParameters(scenario, 1, scenario.parameters or ())
    for node in scenario.parameters or ():
        try:
            parameters.of(node, component_class(node, parameters.given[node]).config_type)
        except ConfigError as error:
            raise ConfigError(source, f"parameters.{node}.{error.key}", error.problem) from None
