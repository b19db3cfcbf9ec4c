"""YAML from a command line into messages."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from perch_core.config import parse_yaml

from ros_graph.commands import GraphError


def parse(text: str, what: str) -> dict[str, Any]:
    """A mapping in YAML, as in `{armed: true}`; nothing for an empty text.

    Raises:
        ConfigError: not YAML.
        GraphError: not a mapping.
    """
    values = parse_yaml(text, what) if text else {}
    if not isinstance(values or {}, dict):
        raise GraphError(f"{what}: expected fields as in '{{name: value}}', got {text!r}")
    return values or {}


def fill(message: Any, values: dict[str, Any], path: str = "") -> Any:
    """Write values into a message, converting numbers to the types of the fields.

    Returns:
        The message.

    Raises:
        GraphError: a field that does not exist, or a value that does not fit.
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
            setattr(message, name, _convert(message, name, types[name], present, value, here))
        except (TypeError, ValueError, AssertionError, OverflowError):
            raise GraphError(f"{here}: {value!r} does not fit {types[name]}") from None
    return message


def _convert(message: Any, name: str, type_name: str, present: Any, value: Any, here: str) -> Any:
    """A value in the type of its field."""
    if not ("[" in type_name or type_name.startswith("sequence")):
        return _scalar(type_name, value)
    if not isinstance(value, list):
        raise TypeError
    if "/" in type_name:
        slot = message.SLOT_TYPES[list(message.get_fields_and_field_types()).index(name)]
        cls = _element_class(slot)
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
    return value


def _element_class(slot: Any) -> type:
    """The message class of an array's elements."""
    namespaced = slot.value_type
    return getattr(importlib.import_module(".".join(namespaced.namespaces)), namespaced.name)
