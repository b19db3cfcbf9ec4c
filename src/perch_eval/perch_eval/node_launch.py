"""The nodes to start for a scenario, and their parameters.

A node's parameters come from `config/<node>.yaml`, from the scenario as a whole (vehicle, seed, lockstep participants),
from the scenario's `parameters`, and from the caller's overrides; later ones take precedence. The result is written into
one file per node, the only source of its parameters, so that the log folder documents the flight.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from perch_core import config
from perch_core.errors import ConfigError, PerchError
from perch_planner.perching_planner import TIME_LIMIT_MAX
from perch_sim.lockstep import PARTICIPANTS
from perch_sim.scenario import NODES, Scenario

ALWAYS = ("description",)
"""Nodes that are started with every scenario."""
HOST_PARAMETERS = ("lockstep", "lockstep_hold", "use_sim_time")
"""Parameters of a node's host; they are not passed to its component."""


@dataclass(frozen=True)
class NodeLaunch:
    """One node to start.

    Attributes:
        name: node and executable.
        parameters: of the component, parameter -> value, nested or dotted.
        host: parameters of the host, see `HOST_PARAMETERS`.
    """

    name: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    host: Mapping[str, Any] = field(default_factory=dict)

    @property
    def package(self) -> str:
        """Package of the node."""
        return NODES[self.name]

    @property
    def module(self) -> str:
        """Python module with the node's `create`."""
        return f"{self.package}.{self.name}_node"

    def write(self, folder: Path) -> Path:
        """Write the parameters as a ROS parameter file, valid in every namespace."""
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / f"{self.name}.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": {**self.parameters, **self.host}}}, sort_keys=True))
        return file


def choose_nodes(scenario: Scenario, only: Sequence[str] = (), without: Sequence[str] = (),
                 extra: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the nodes to start.

    Args:
        scenario: names the nodes that are started by default.
        only: start these instead; they need not be among the scenario's.
        without: leave these out.
        extra: start these too.

    Raises:
        PerchError: a node does not exist, one to leave out would not be started anyway, or none is left.
    """
    for node in (*only, *without, *extra):
        if node not in NODES:
            raise PerchError(f"node {node!r} is not one of {', '.join(NODES)}")
    available = tuple(dict.fromkeys((*(only or (*scenario.nodes, *ALWAYS)), *extra)))
    for node in without:
        if node not in available:
            raise PerchError(f"node {node!r} is not started anyway; started: {', '.join(available)}")
    chosen = tuple(node for node in available if node not in without)
    if not chosen:
        raise PerchError("no node is left to start")
    return chosen


def node_launches(scenario: Scenario, nodes: Sequence[str], *, seed: int = 1, scenario_source: str = "",
                  lockstep: bool = True, overrides: Mapping[str, Mapping[str, Any]] | None = None) -> tuple[NodeLaunch, ...]:
    """Return the nodes with their parameters.

    Args:
        scenario: what is flown.
        nodes: to start.
        seed: of every random number in the flight.
        scenario_source: name or file of the scenario, for the nodes that read it themselves.
        lockstep: simulation time waits for all participants; otherwise the wall clock paces it.
        overrides: node -> parameter -> value; they take precedence over everything else.

    Raises:
        ConfigError: a parameter file is malformed.
        PerchError: an override for a node that is not started.
    """
    overrides = overrides or {}
    for node in overrides:
        if node not in nodes:
            raise PerchError(f"parameter for node {node!r}, which is not started; started: {', '.join(nodes)}")
    common = _scenario_parameters(scenario, nodes, seed, scenario_source or scenario.name, lockstep)
    launches = []
    for node in nodes:
        parameters = config.flattened(read_parameters(node)) | common.get(node, {}) | _host_parameters(node, lockstep)
        parameters |= config.flattened((scenario.parameters or {}).get(node, {})) | config.flattened(overrides.get(node, {}))
        host = {name: parameters.pop(name) for name in HOST_PARAMETERS if name in parameters}
        launches.append(NodeLaunch(node, parameters, host))
    return tuple(launches)


def read_parameters(node: str) -> dict[str, Any]:
    """Return the parameters of `config/<node>.yaml`; none if there is no such file.

    Raises:
        ConfigError: the file holds anything other than `/**: ros__parameters:`.
    """
    file = config.config_dir() / f"{node}.yaml"
    try:
        return parameters_in(file, file.stat().st_mtime_ns)
    except FileNotFoundError:
        return {}


@functools.lru_cache(maxsize=32)
def parameters_in(file: Path, changed: int) -> dict[str, Any]:
    """Return the parameters that a file sets in every namespace; `changed` is its modification time [ns], a key of the cache.

    Raises:
        ConfigError: the file holds anything other than `/**: ros__parameters:`.
    """
    content = config.read_yaml(file)
    if not isinstance(content, dict) or set(content) != {"/**"}:
        raise ConfigError(str(file), "", "must hold one key, '/**', which is true in every namespace")
    parameters = content["/**"]
    if not isinstance(parameters, dict) or set(parameters) != {"ros__parameters"}:
        raise ConfigError(str(file), "/**", "must hold one key, 'ros__parameters'")
    found = parameters["ros__parameters"] or {}
    if not isinstance(found, dict):
        raise ConfigError(str(file), "/**.ros__parameters", f"{found!r} is not a mapping")
    return found


def parse_overrides(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Parse `node.parameter:=value` texts, with values in YAML, to node -> parameter -> value; later ones take precedence.

    Raises:
        PerchError: a text of another form.
    """
    overrides: dict[str, dict[str, Any]] = {}
    for text in texts:
        target, assigned, value = text.partition(":=")
        node, dot, parameter = target.partition(".")
        if not (assigned and dot and node and parameter):
            raise PerchError(f"-p {text}: expected NODE.PARAMETER:=VALUE, as in controller.gains.lead:=0.02")
        overrides.setdefault(node, {})[parameter] = config.parse_yaml(value, f"-p {text}")
    return overrides


def _host_parameters(node: str, lockstep: bool) -> dict[str, Any]:
    """Return a node's host parameters in simulation. Time is that of `/clock`, which the vehicle publishes, also in real time,
    where the wall clock paces the vehicle itself."""
    if node == "vehicle":
        return {"lockstep": lockstep, "use_sim_time": lockstep}
    return {"lockstep": lockstep, "use_sim_time": True} if node in PARTICIPANTS else {"use_sim_time": True}


def _scenario_parameters(scenario: Scenario, nodes: Sequence[str], seed: int, source: str, lockstep: bool) -> dict[str, dict[str, Any]]:
    """Return the parameters of each node that follow from the scenario as a whole."""
    participants = [node for node in nodes if node in PARTICIPANTS]
    vehicle = {"vehicle": scenario.vehicle}
    mission: dict[str, Any] = {"mission.planner_latency": scenario.latency.perching_planner,
               "mission.powerline_latency": scenario.latency.powerline_planner}
    controller: dict[str, Any] = dict(vehicle)
    # in lockstep simulation time waits: what is flown depends on no processor
    planner = vehicle | ({"time_limit": TIME_LIMIT_MAX} if lockstep else {})
    if scenario.mode == "inspection":
        mission |= {"mission.waypoints": [v for w in scenario.inspection.waypoints for v in (*w.position, w.yaw_deg)],
                    "mission.inspection_speed": scenario.inspection.speed}
        controller["nmpc.lines.watched"] = list(scenario.inspection.watched)
    return {
        "viewer": {"scenario": source}, "description": vehicle,
        "vehicle": vehicle | {"scenario": source, "seed": seed, "participants": participants or [""]},
        "vio": vehicle | {"start_position": list(scenario.start.position), "start_yaw_deg": scenario.start.yaw_deg},
        # in lockstep the schedule delays its outputs
        "vio_model": vehicle | {"seed": seed, "latency": 0.0 if lockstep else scenario.latency.vio}, "powerline_mapper": vehicle,
        "target_localizer": vehicle | {"board": scenario.target.board},
        "perching_planner": planner, "powerline_planner": vehicle, "controller": controller, "mission": mission,
    }
