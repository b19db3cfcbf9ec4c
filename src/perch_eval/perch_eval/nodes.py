"""The programs of a scenario for a `Stack`: one per node, and one for the nodes that share a process."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_eval.node_launch import NodeLaunch, choose_nodes, node_launches
from perch_eval.program import Program
from perch_sim.scenario import NODES, Scenario

ALL_NODES = tuple(NODES)
CHAIN_NODES = ("vehicle", "estimator", "controller", "description")
"""Nodes that every step waits for, and the one that publishes the transforms: in real time only these share a process."""
FAST_NODES = (*CHAIN_NODES, "mission", "recorder")
"""Nodes with little work at many steps: messages between processes would cost more than this work."""
PER_VEHICLE = ("/clock", "/tf", "/tf_static")
"""Absolute topics that are remapped into a vehicle's namespace: simulated vehicles have separate clocks and equal frame names."""


def sharing(names: Collection[str] | None, otherwise: Collection[str] = ()) -> Collection[str]:
    """Return the nodes that share a process by option `--composed [NODE ...]`: all if it has no names, `otherwise` without it."""
    return otherwise if names is None else names or ALL_NODES


def programs(scenario: Scenario, seed: int = 1, *, folder: Path, scenario_source: str = "", composed: Collection[str] = (), lockstep: bool = True,
             record: Path | None = None, hold_for_goal: bool = False, overrides: Mapping[str, Mapping[str, Any]] | None = None) -> tuple[Program, ...]:
    """Return the programs of a whole scenario.

    Args:
        scenario, seed, scenario_source, lockstep: as in `node_launches`.
        folder, composed: as in `node_programs`.
        record: add a recorder that writes this MCAP file.
        hold_for_goal: hold simulation time until the mission has a goal.
        overrides: node -> parameter -> value, over everything else; `record` and `hold_for_goal` replace those of their nodes.

    Raises:
        PerchError: parameters or nodes are refused, or the workspace is not built.
    """
    nodes = choose_nodes(scenario, extra=("recorder",) if record else ())
    own = dict(overrides or {})
    if record:
        own["recorder"] = {"file": str(record.absolute())}
    if hold_for_goal and "mission" in nodes:
        own["mission"] = {"lockstep_hold": "perch"}
    launches = node_launches(scenario, nodes, seed=seed, scenario_source=scenario_source, lockstep=lockstep, overrides=own)
    return node_programs(launches, folder, composed=composed)


def node_programs(launches: Sequence[NodeLaunch], folder: Path, *, namespace: str = "", composed: Collection[str] = ()) -> tuple[Program, ...]:
    """Return the programs for some nodes, and write their parameter files into `folder`.

    Args:
        launches: nodes with their parameters.
        folder: receives the parameter files.
        namespace: of every node, as in `/quad1`.
        composed: nodes that share a process, as far as they are among `launches`; the others have one each.

    Raises:
        PerchError: a node to compose does not exist, or the workspace is not built or not sourced.
    """
    for name in composed:
        if name not in NODES:
            raise PerchError(f"node {name!r} is not one of {', '.join(NODES)}")
    arguments = {launch.name: ros_arguments(launch, folder, namespace) for launch in launches}
    together = [launch for launch in launches if launch.name in composed]
    found, prefix = [], namespace.rstrip("/")
    if together:
        plan = folder / "composed.json"
        plan.write_text(json.dumps([{"name": n.name, "module": n.module, "arguments": arguments[n.name]} for n in together], indent=1))
        found.append(Program("composed", (executable("perch_eval", "composed"), str(plan)), tuple(f"{prefix}/{n.name}" for n in together)))
    found += [Program(n.name, (executable(n.package, n.name), *arguments[n.name]), (f"{prefix}/{n.name}",)) for n in launches if n not in together]
    return tuple(found)


def executable(package: str, name: str) -> str:
    """Path of an installed executable. `ros2 run` is not used: it orphans the node when it is terminated.

    Raises:
        PerchError: the package or the executable is not installed.
    """
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "lib", package, name)
        if prefix and path.exists():
            return str(path)
    raise PerchError(f"executable {name} of package {package} is not found: run scripts/setup.py, then source setup.bash")


def ros_arguments(launch: NodeLaunch, folder: Path, namespace: str = "") -> list[str]:
    """Return the ROS arguments of a node, and write its parameter file into `folder`."""
    return ["--ros-args", *in_namespace(namespace), "--params-file", str(launch.write(folder))]


def in_namespace(namespace: str) -> list[str]:
    """Return the remapping arguments of a node in a namespace; none if it is empty."""
    if not namespace.strip("/"):
        return []
    return ["-r", f"__ns:={namespace}", *(word for topic in PER_VEHICLE for word in ("-r", f"{topic}:={topic.lstrip('/')}"))]
