"""Classes of messages, services and actions by name."""

from __future__ import annotations

import importlib

from ros_graph.commands import GraphError


def interface(name: str, kind: str) -> type:
    """The class of an interface.

    Args:
        name: as in `perch_msgs/msg/Trajectory`; the middle part may be left out.
        kind: `msg`, `srv` or `action`.

    Raises:
        GraphError: no such package or interface, or an interface of another kind.
    """
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, kind)
    if len(parts) != 3 or parts[1] != kind or not all(parts):
        raise GraphError(f"type {name!r}: expected PACKAGE/{kind}/NAME")
    package, _, last = parts
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), last)
    except (ImportError, AttributeError):
        raise GraphError(f"type {name!r} is not known here: is its package built and sourced?") from None
