"""Parameters of every node of a scenario as their frozen dataclasses, from the same sources as the real nodes'."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from perch_core import config
from perch_core.errors import PerchError
from perch_core.scenario import Scenario
from perch_eval.node_launch import node_launches

T = TypeVar("T")

FLOWN = ("vio_model", "vio", "estimator", "target_localizer", "powerline_mapper", "perching_planner", "powerline_planner",
         "controller", "mission")


class NodeParameters:
    """What `config/<node>.yaml`, the scenario and its `parameters` say for each node."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """
        Raises:
            ConfigError: a parameter file is none.
        """
        # The scenario may name parameters of either VIO; both are read, one is flown.
        self._launches = {launch.name: launch for launch in node_launches(scenario, FLOWN, seed=seed)}

    def of(self, node: str, cls: type[T]) -> T:
        """The parameters of a node.

        Raises:
            ConfigError: one of them is unknown, of the wrong type, or out of range.
        """
        return config.from_mapping(cls, nested(self._launches[node].parameters), node)


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names as nested mappings."""
    out: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, leaf = name.split(".")
        place = out
        for group in groups:
            place = place.setdefault(group, {})
            if not isinstance(place, dict):
                raise PerchError(f"parameter {name!r}: {group!r} is a value, not a group")
        place[leaf] = value
    return out
