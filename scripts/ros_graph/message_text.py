"""Messages as YAML, as `ros2 topic echo` prints them.

`rosidl_runtime_py`, which does this elsewhere, is not among the wheels.
"""

from __future__ import annotations

import array
import re
from typing import Any

import numpy as np
import yaml

from ros_graph.commands import GraphError

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
LONGEST = 128  # elements of an array, and letters of a string, that are shown
_SEQUENCES = (list, tuple, bytes, bytearray, array.array, np.ndarray)


def to_yaml(value: Any, arrays: bool = True) -> str:
    """A message, or a value out of one, as YAML with a final newline; without `arrays` only their types."""
    data = _plain(value, arrays)
    if not isinstance(data, (dict, list)):
        return f"{data}\n"
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=1_000_000, default_flow_style=False)


def _plain(value: Any, arrays: bool, type_name: str = "") -> Any:
    """A message as dictionaries, lists, numbers and strings; long ones are cut."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name), arrays, kind) for name, kind in value.get_fields_and_field_types().items()}
    if isinstance(value, _SEQUENCES):
        if not arrays:
            return f"<array type: {type_name or 'array'}, length: {len(value)}>"
        return [_plain(item, arrays) for item in value[:LONGEST]] + ["..."] * (len(value) > LONGEST)
    if isinstance(value, str):
        return value if len(value) <= LONGEST else f"{value[:LONGEST]}..."
    return value.item() if isinstance(value, np.generic) else value


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
