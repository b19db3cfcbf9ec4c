"""The nodes `target_localizer` and `powerline_mapper` without images: detections are generated from the truth by the error models
of in-process flights. For campaigns over ROS without rendering.

    python3 -m perch_eval.modelled_sight_node target_localizer --ros-args -p scenario:=surface_90 -p seed:=3
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from perch_core.config import quantity, text
from perch_core.ros.node import NodeSpec
from perch_eval.in_process.modelled_sight import LONG_TRUTH_BUFFER, ModelledLocalizer, ModelledMap, ModelledSight
from perch_eval.node_launch import NodeLaunch, choose_nodes, node_launches
from perch_eval.program import Program
from perch_perception.target_localizer import TargetLocalizer, TargetLocalizerConfig
from perch_sim.lockstep import START
from perch_sim.obstacles import pad_surface
from perch_sim.scenario import Scenario, load_scenario
from perch_sim.state_history import StateHistory


@dataclass(frozen=True)
class SightParameters(TargetLocalizerConfig):
    """Parameters of the localiser, and scenario and seed of the truth."""

    scenario: str = text("surface_90", doc="config/scenarios/<name>.yaml, or a file")
    seed: int = quantity(1, low=0, high=2**31 - 1, doc="of everything that is random")


class TruthLocalizer(ModelledSight[SightParameters], TargetLocalizer):
    """Target localiser whose sightings are generated from the truth."""

    config_type = SightParameters

    def __init__(self, config: SightParameters) -> None:
        """
        Raises:
            ConfigError: no such scenario, vehicle, camera or board.
        """
        scenario = load_scenario(config.scenario)
        self.true_states = StateHistory(LONG_TRUTH_BUFFER)
        self._sight = ModelledLocalizer(config, scenario, config.seed, self.true_states,
                                        lambda: pad_surface(scenario, (self.true_states.newest - START) * 1e-9))
        super().__init__(config, self._sight)

    def middle(self, exposure_time: float) -> int:
        """As `ModelledLocalizer.middle`."""
        return self._sight.middle(exposure_time)


TARGET_LOCALIZER = NodeSpec("target_localizer", TruthLocalizer)
POWERLINE_MAPPER = NodeSpec("powerline_mapper", ModelledMap)
NODES = {one.name: one for one in (TARGET_LOCALIZER, POWERLINE_MAPPER)}
MODULE = "perch_eval.modelled_sight_node"


def imageless_launches(scenario: Scenario, seed: int, source: str, lockstep: bool, extra: Sequence[str] = (), **options: Any
                   ) -> tuple[NodeLaunch, ...]:
    """Return the nodes that fly a scenario without images, with their parameters.

    Args:
        scenario, seed, source: the scenario, seed of the random numbers, name or file of the scenario.
        lockstep: as in `node_launch.node_launches`.
        extra: nodes beside those of the scenario.
        options: further arguments of `node_launch.node_launches`.
    """
    nodes = ["vio_model" if name == "vio" else name for name in choose_nodes(scenario, extra=extra)]
    own: dict[str, Any] = {"scenario": source, "seed": seed}
    changed = {"vehicle": lambda p: {**p, "cameras": "none"}, "target_localizer": lambda p: {**p, **own}, "powerline_mapper": lambda p: {**p, **own}}
    launches = node_launches(scenario, nodes, seed=seed, scenario_source=source, lockstep=lockstep, **options)
    return tuple(NodeLaunch(one.name, changed.get(one.name, dict)(one.parameters), one.host) for one in launches)


def imageless_programs(programs: Sequence[Program]) -> tuple[Program, ...]:
    """Return the programs with their image-processing nodes replaced by those of this module."""
    return tuple(Program(one.name, (sys.executable, "-m", MODULE, one.name, *one.command[1:]), one.nodes) if one.name in NODES else one
                 for one in programs)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in NODES:
        sys.exit(f"usage: python3 -m {MODULE} {' | '.join(NODES)} --ros-args ...")
    NODES[sys.argv.pop(1)].main()
