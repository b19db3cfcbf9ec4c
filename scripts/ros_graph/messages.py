"""Messages, services and actions: their classes by name, filled from YAML of a command line, and printed as `ros2 topic echo` prints them.

`rosidl_runtime_py`, which does this elsewhere, is not among the wheels.
"""

from __future__ import annotations

import array
import importlib
import re
from typing import Any

import numpy as np
import yaml
from perch_core.config import parse_yaml

from ros_graph.commands import GraphError

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
LONGEST = 128  # elements of an array, and letters of a string, that are shown
_SEQUENCES = (list, tuple, array.array, np.ndarray)


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
    if len(parts) != 3 or parts[1] != kind or not all(parts) or parts[2].startswith("_"):  # which are modules
        raise GraphError(f"type {name!r}: expected PACKAGE/{kind}/NAME")
    package, _, last = parts
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), last)
    except (ImportError, AttributeError, TypeError):
        raise GraphError(f"type {name!r} is not known here: is its package built and sourced?") from None


def parse(text: str, what: str) -> dict[str, Any]:
    """Parse a mapping in YAML, as in `{armed: true}`; empty for an empty text.

    Raises:
        ConfigError: the text is not YAML.
        GraphError: the text is not a mapping.
    """
    values = parse_yaml(text or "{}", what)
    if not isinstance(values, dict):
        raise GraphError(f"{what}: expected fields as in '{{name: value}}', got {text!r}")
    return values


def fill(message: Any, values: dict[str, Any], path: str = "") -> Any:
    """Write values into a message, converting numbers to the types of the fields.

    Returns:
        The message.

    Raises:
        GraphError: a field does not exist, or a value does not fit.
    """
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        here = f"{path}{name}"
        if name not in types:
            raise GraphError(f"{here}: no such field; there are: {', '.join(types)}")
        present = getattr(message, name)
        if hasattr(present, "get_fields_and_field_types"):
            if not isinstance(value, dict):
                raise GraphError(f"{here}: expected a mapping, got {value!r}")
            fill(present, value, f"{here}.")
            continue
        try:
            setattr(message, name, _convert(types[name], present, value, here))
        except (TypeError, ValueError, AssertionError, OverflowError):
            raise GraphError(f"{here}: {value!r} does not fit {types[name]}") from None
    return message


def _convert(type_name: str, present: Any, value: Any, here: str) -> Any:
    """Convert a value to the type of its field."""
    if not ("[" in type_name or type_name.startswith("sequence")):
        return _scalar(type_name, value)
    if not isinstance(value, list):
        raise TypeError
    if "/" in type_name:
        cls = interface(re.findall(r"\w+/\w+", type_name)[0], "msg")
        return [fill(cls(), item, f"{here}[{i}].") for i, item in enumerate(value)]
    element = type_name.removeprefix("sequence<").split("[")[0].rstrip(">").split(",")[0]
    items = [_scalar(element, item) for item in value]
    if isinstance(present, np.ndarray):
        if len(items) != len(present):
            raise ValueError
        return np.array(items, dtype=present.dtype)
    return items


def _scalar(type_name: str, value: Any) -> Any:
    if type_name in ("float", "double", "float32", "float64"):
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise TypeError
        return float(value)
    if type_name == "boolean":
        if not isinstance(value, bool):
            raise TypeError
        return value
    if type_name.startswith(("string", "wstring")):
        return value if isinstance(value, str) else str(value)
    if type_name == "octet":
        return bytes([value])
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError
    limits = np.iinfo(type_name)
    if not limits.min <= value <= limits.max:  # rclpy would keep the low bytes
        raise ValueError
    return value


def to_yaml(value: Any, arrays: bool = True) -> str:
    """Return a message, or a value of one, as YAML with a final newline; without `arrays` only type and length of arrays."""
    data = _plain(value, arrays)
    if not isinstance(data, (dict, list)):
        return f"{data}\n"
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=1_000_000, default_flow_style=False)


def _plain(value: Any, arrays: bool, type_name: str = "") -> Any:
    """Convert a message to dictionaries, lists, numbers and strings; long lists and strings are truncated."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name), arrays, kind) for name, kind in value.get_fields_and_field_types().items()}
    if isinstance(value, _SEQUENCES):
        if not arrays:
            return f"<array type: {type_name or 'array'}, length: {len(value)}>"
        return [_plain(item, arrays) for item in value[:LONGEST]] + ["..."] * (len(value) > LONGEST)
    if isinstance(value, bytes):  # an octet
        return value[0]
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
