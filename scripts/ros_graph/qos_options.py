"""QoS on the command line, and the QoS that hears a topic's publishers."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

PROFILES = ("default", "sensor_data", "services_default", "parameters", "system_default")


def add_qos_options(target: argparse.ArgumentParser) -> None:
    """The options of `ros2 topic` for QoS. Standard library only."""
    target.add_argument("--qos-profile", choices=PROFILES, help="a preset profile")
    target.add_argument("--qos-depth", type=int, metavar="N", help="queue size")
    target.add_argument("--qos-history", choices=("keep_last", "keep_all"))
    target.add_argument("--qos-reliability", choices=("reliable", "best_effort", "system_default"))
    target.add_argument("--qos-durability", choices=("volatile", "transient_local", "system_default"))


def chosen_qos(arguments: argparse.Namespace, endpoints: Sequence[Any] = ()) -> Any:
    """The QoS that the caller asked for; what is left open fits to all publishers of the topic.

    Args:
        arguments: parsed options of `add_qos_options`.
        endpoints: `TopicEndpointInfo` of the publishers.
    """
    from rclpy.qos import (
        DurabilityPolicy,
        HistoryPolicy,
        QoSPresetProfiles,
        QoSProfile,
        ReliabilityPolicy,
    )

    preset = QoSPresetProfiles.get_from_short_key(arguments.qos_profile or "default")
    profile = QoSProfile(
        history=preset.history, depth=preset.depth, reliability=preset.reliability, durability=preset.durability
    )
    if endpoints and not arguments.qos_profile:
        profiles = [endpoint.qos_profile for endpoint in endpoints]
        if any(p.reliability == ReliabilityPolicy.BEST_EFFORT for p in profiles):
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        if all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles):
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    if arguments.qos_depth is not None:
        profile.depth = arguments.qos_depth
    if arguments.qos_history:
        profile.history = HistoryPolicy.get_from_short_key(arguments.qos_history)
    if arguments.qos_reliability:
        profile.reliability = ReliabilityPolicy.get_from_short_key(arguments.qos_reliability)
    if arguments.qos_durability:
        profile.durability = DurabilityPolicy.get_from_short_key(arguments.qos_durability)
    return profile
