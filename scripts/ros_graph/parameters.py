"""Sub-commands that read and set parameters of running nodes."""

from __future__ import annotations

import argparse
from typing import Any

import yaml
from perch_core.config import nested, parse_yaml
from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient

from ros_graph.commands import GraphError
from ros_graph.connection import GraphConnection, hidden

TYPES = {getattr(ParameterType, f"PARAMETER_{kind.upper().replace(' ', '_')}"): kind for kind in (
    "bool", "integer", "double", "string", "byte array", "bool array", "integer array", "double array", "string array")}


def list_parameters(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `param.py list`, of one node or of all."""
    nodes = [graph.absolute(arguments.node)] if arguments.node else _nodes(graph, arguments.spin_time)
    for node in nodes:
        names = _names(graph, _client(graph, node, arguments.spin_time), node)
        if not arguments.node:
            print(f"{node}:")
        print("".join(f"  {name}\n" for name in names), end="")
    return 0


def get_parameter(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `param.py get`."""
    node, client = _node(graph, arguments)
    value = _values(graph, client, node, [arguments.parameter])[0]
    if value.type == ParameterType.PARAMETER_NOT_SET:
        raise GraphError(f"{node} has no parameter {arguments.parameter!r}; 'param.py list {node}' shows all")
    shown = _plain(parameter_value_to_python(value))
    print(shown if not isinstance(shown, str) else repr(shown))
    return 0


def describe_parameters(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `param.py describe`: print meaning, type, unit and allowed values of parameters."""
    node, client = _node(graph, arguments)
    names = arguments.parameter or _names(graph, client, node)
    values = _values(graph, client, node, names)
    found = graph.answer(client.describe_parameters(names), node).descriptors
    for name, value, descriptor in zip(names, values, found):
        if value.type == ParameterType.PARAMETER_NOT_SET and not descriptor.description:
            raise GraphError(f"{node} has no parameter {name!r}; 'param.py list {node}' shows all")
        print(f"{name}: {_plain(parameter_value_to_python(value))!r}")
        print(f"    {_allowed(descriptor)}")
        if descriptor.description:
            print(f"    {descriptor.description}")
    return 0


def _allowed(descriptor: ParameterDescriptor) -> str:
    """Describe type, range, unit and other limits of a parameter, and whether it can change."""
    parts = [TYPES.get(descriptor.type, "of any type")]
    for limits in (*descriptor.floating_point_range, *descriptor.integer_range):
        above = "> " in descriptor.additional_constraints  # an exclusive bound: the range begins with the next number
        parts.append(f"to {limits.to_value:g}" if above else f"from {limits.from_value:g} to {limits.to_value:g}")
    if descriptor.additional_constraints:
        parts.append(descriptor.additional_constraints)
    if descriptor.read_only:
        parts.append("read-only: fixed after the start")
    return ", ".join(parts)


def set_parameter(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `param.py set`: return 1 if the node refuses the value, otherwise 0."""
    value = parse_yaml(arguments.value, "value")
    node, client = _node(graph, arguments)
    name = arguments.parameter
    present = _values(graph, client, node, [name])[0]
    if present.type == ParameterType.PARAMETER_DOUBLE and type(value) is int:
        value = float(value)
    if present.type == ParameterType.PARAMETER_DOUBLE_ARRAY and isinstance(value, list):
        value = [float(item) if type(item) is int else item for item in value]
    try:
        parameter = Parameter(name, value=value)
    except (TypeError, ValueError, AssertionError):
        raise GraphError(f"{name}: {value!r} is not a value that a parameter can have") from None
    result = graph.answer(client.set_parameters([parameter]), node).results[0]
    if not result.successful:
        print(f"{node} refused {name}: {result.reason}")
        return 1
    print(f"{node}: {name} is now {value!r}")
    return 0


def dump_parameters(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `param.py dump`: print the parameters as a parameter file."""
    node, client = _node(graph, arguments)
    names = _names(graph, client, node)
    values = _values(graph, client, node, names)
    known = {name: value for name, value in zip(names, values) if value.type != ParameterType.PARAMETER_NOT_SET}
    tree = nested({name: _plain(parameter_value_to_python(value)) for name, value in known.items()})
    print(yaml.safe_dump({node: {"ros__parameters": tree}}, sort_keys=False), end="")
    return 0


def _node(graph: GraphConnection, arguments: argparse.Namespace) -> tuple[str, AsyncParameterClient]:
    """Return the full name of the command line's node, and a client of its parameters."""
    name = graph.absolute(arguments.node)
    return name, _client(graph, name, arguments.spin_time)


def _nodes(graph: GraphConnection, timeout: float) -> list[str]:
    """Return the nodes that have parameters and are not hidden."""
    def found() -> set[str]:
        services = {name for name, _ in graph.node.get_service_names_and_types()}
        return {node for node in graph.nodes() if f"{node}/list_parameters" in services}

    return sorted(name for name in graph.settle(found, timeout) if not hidden(name))


def _client(graph: GraphConnection, node: str, timeout: float) -> AsyncParameterClient:
    client = AsyncParameterClient(graph.node, node)
    if not graph.spin_until(client.services_are_ready, timeout):
        others = [name for name in _nodes(graph, 1.0) if name != node]  # our client gives it the names of services that it lacks
        raise GraphError(f"node {node} does not exist or has no parameters; nodes that have: {', '.join(others) or 'none'}")
    return client


def _names(graph: GraphConnection, client: AsyncParameterClient, node: str) -> list[str]:
    return sorted(graph.answer(client.list_parameters([], 0), node).result.names)


def _values(graph: GraphConnection, client: AsyncParameterClient, node: str, names: list[str]) -> list[Any]:
    values = list(graph.answer(client.get_parameters(names), node).values)
    if len(values) != len(names):  # the response of a node that lacks one of them
        missing = sorted(set(names) - set(_names(graph, client, node)))
        raise GraphError(f"{node} does not have {', '.join(missing)}; 'param.py list {node}' shows all")
    return values


def _plain(value: Any) -> Any:
    """Convert arrays to lists, bytes to numbers."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value
