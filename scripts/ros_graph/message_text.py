"""Messages as text: YAML as `ros2 topic echo` prints it, or one line of CSV.

`rosidl_runtime_py`, which does this elsewhere, is not among the wheels.
"""

from __future__ import annotations

import array
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from ros_graph.commands import GraphError

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
_SEQUENCES = (list, tuple, bytes, bytearray, array.array, np.ndarray)


@dataclass(frozen=True)
class TextOptions:
    """How much of a message is shown.

    Attributes:
        arrays: show the elements of arrays, not only their type.
        strings: show strings, not only their type.
        length: elements of an array and letters of a string; None for all.
        flow: short arrays on one line.
    """

    arrays: bool = True
    strings: bool = True
    length: int | None = 128
    flow: bool = False


def to_yaml(value: Any, options: TextOptions = TextOptions()) -> str:
    """A message, or a value out of one, as YAML with a final newline."""
    data = to_plain(value, options)
    if not isinstance(data, (dict, list)):
        return f"{data}\n"
    return yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, width=1_000_000, default_flow_style=None if options.flow else False
    )


def to_csv(value: Any, options: TextOptions = TextOptions()) -> str:
    """Every number and string of a message, depth first, separated by commas."""

    def leaves(data: Any) -> list[str]:
        if isinstance(data, dict):
            return [leaf for item in data.values() for leaf in leaves(item)]
        if isinstance(data, list):
            return [leaf for item in data for leaf in leaves(item)]
        return [str(data)]

    return ",".join(leaves(to_plain(value, options))) + "\n"


def to_plain(value: Any, options: TextOptions, type_name: str = "") -> Any:
    """A message as dictionaries, lists, numbers and strings."""
    if hasattr(value, "get_fields_and_field_types"):
        return {
            name: to_plain(getattr(value, name), options, field_type)
            for name, field_type in value.get_fields_and_field_types().items()
        }
    if isinstance(value, _SEQUENCES):
        return _sequence(value, options, type_name)
    if isinstance(value, str):
        if not options.strings:
            return f"<string length: <{len(value)}>>"
        return value if options.length is None or len(value) <= options.length else f"{value[: options.length]}..."
    return value.item() if isinstance(value, np.generic) else value


def _sequence(value: Any, options: TextOptions, type_name: str) -> Any:
    if not options.arrays:
        return f"<array type: {type_name or 'array'}, length: {len(value)}>"
    shown = value if options.length is None else value[: options.length]
    items = [to_plain(item, options) for item in shown]
    return items if len(shown) == len(value) else [*items, "..."]


def pick(message: Any, path: str) -> Any:
    """A part of a message, as in `pose.pose.position.x` or `rotor_speed[2]`.

    Raises:
        GraphError: no such part.
    """
    value = message
    for name, index in _STEP.findall(path):
        try:
            value = getattr(value, name) if name else value[int(index)]
        except AttributeError:
            known = getattr(value, "get_fields_and_field_types", dict)()
            there_are = f"; there are: {', '.join(known)}" if known else ""
            raise GraphError(f"--field {path}: {name!r} does not exist{there_are}") from None
        except (IndexError, TypeError):
            raise GraphError(f"--field {path}: [{index}] does not exist") from None
    return value
