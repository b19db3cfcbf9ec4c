"""Components of a scenario with their parameters, from the same sources as those of the real nodes."""

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
"""Node -> class of its component, as `module:class`."""


def component_class(node: str, parameters: Mapping[str, Any]) -> type[Component[Any]]:
    """Return the class of a node's component; that of `estimator` is selected by its parameter `type`.

    Raises:
        ConfigError: there is no such estimator.
    """
    if node == "estimator" and "type" in parameters:
        return estimator_class(parameters["type"])
    return resolved(COMPONENTS[node])


class NodeParameters:
    """Parameters of each node from `config/<node>.yaml`, the scenario and its `parameters`.

    Attributes:
        given: node -> parameters by dotted name.
    """

    def __init__(self, scenario: Scenario, seed: int, nodes: Collection[str] = tuple(COMPONENTS)) -> None:
        """
        Args:
            scenario: scenario to be flown.
            seed: seed of the flight.
            nodes: names of the nodes.

        Raises:
            ConfigError: a parameter file is invalid.
        """
        # The scenario may name parameters of either VIO; both are read, one is flown.
        self.given = {launch.name: launch.parameters for launch in node_launches(scenario, tuple(nodes), seed=seed)}

    def of(self, node: str, cls: type[T]) -> T:
        """Return the parameters of a node.

        Raises:
            ConfigError: a parameter is unknown, of the wrong type, or out of range.
        """
        return config.from_mapping(cls, config.nested(self.given[node]), node)  # type: ignore[type-var]

    def component(self, node: str) -> Component[Any]:
        """Create the component of a node with its parameters.

        Raises:
            ConfigError: a parameter is invalid.
        """
        cls = component_class(node, self.given[node])
        return cls(self.of(node, cls.config_type))


def check_parameters(scenario: Scenario, source: str) -> None:
    """Check the parameters that a scenario sets for nodes.

    Raises:
        ConfigError: a parameter is invalid; contains its place in the scenario.
    """
    parameters = NodeParameters(scenario, 1, scenario.parameters or ())
    for node in scenario.parameters or ():
        try:
            parameters.of(node, component_class(node, parameters.given[node]).config_type)
        except ConfigError as error:
            raise ConfigError(source, f"parameters.{node}.{error.key}", error.problem) from None
