"""Lists topics and describes their publishers and subscribers."""

from __future__ import annotations

import argparse

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ros_graph.commands import GraphError
from ros_graph.connection import Visit, show_names, visit
from ros_graph.interfaces import interface


def list_topics(arguments: argparse.Namespace) -> int:
    """`topic.py list`"""
    return show_names(arguments, Node.get_topic_names_and_types)


def show_info(arguments: argparse.Namespace) -> int:
    """`topic.py info`"""
    with visit() as graph:
        topic = graph.absolute(arguments.topic)
        name = topic_type(graph, topic, arguments.spin_time)
        sides = graph.settle(lambda: _sides(graph, topic), arguments.spin_time)
        print(f"Type: {name}\n")
        for side, endpoints in sides.items():
            print(f"{side} count: {len(endpoints)}")
            if arguments.verbose:
                print("\n" + "\n".join(endpoints) + "\n")
    return 0


def topic_type(graph: Visit, topic: str, timeout: float) -> str:
    """Name of a topic's type, as soon as somebody in the graph has the topic.

    Raises:
        GraphError: nobody has it, or there are several types.
    """
    absolute = graph.absolute(topic)
    types = graph.find(lambda: dict(graph.node.get_topic_names_and_types()).get(absolute), timeout)
    if types is None:
        domain = graph.node.context.get_domain_id()
        raise GraphError(f"topic {absolute} does not exist in ROS domain {domain}; 'topic.py list' shows what does")
    if len(types) > 1:
        raise GraphError(f"topic {absolute} has several types: {', '.join(types)}; name one")
    return types[0]


def message_class(graph: Visit, topic: str, given: str | None, timeout: float) -> type:
    """Class of a topic's messages: of the given type, or of the type that the graph knows.

    Raises:
        GraphError: the topic or the type is not known.
    """
    return interface(given or topic_type(graph, topic, timeout), "msg")


def qos_of(graph: Visit, topic: str) -> QoSProfile:
    """QoS that hears all publishers of a topic."""
    profiles = [endpoint.qos_profile for endpoint in graph.node.get_publishers_info_by_topic(topic)]
    profile = QoSProfile(depth=10)
    if any(p.reliability == ReliabilityPolicy.BEST_EFFORT for p in profiles):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if profiles and all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def _sides(graph: Visit, topic: str) -> dict[str, list[str]]:
    return {
        "Publisher": [_describe(e) for e in graph.node.get_publishers_info_by_topic(topic)],
        "Subscription": [_describe(e) for e in graph.node.get_subscriptions_info_by_topic(topic)],
    }


def _describe(endpoint) -> str:
    qos = endpoint.qos_profile
    node = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
    return f"Node: {node}  reliability: {qos.reliability.name}  durability: {qos.durability.name}"
