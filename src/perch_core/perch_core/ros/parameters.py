"""ROS parameters as a frozen dataclass: declared once with type, unit and range; refused when unknown or out of range."""

from __future__ import annotations

import math
import typing
from array import array
from collections.abc import Callable
from dataclasses import Field, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from perch_core import config
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

_FOREIGN = ("use_sim_time", "start_type_description_service", "lockstep", "lockstep_hold")  # of ROS and of the host


def _leaves(cls: type[DataclassInstance], prefix: str = "") -> dict[str, tuple[Field[Any], Any]]:
    """Dotted name -> field and type of every parameter of a configuration class."""
    hints = typing.get_type_hints(cls)
    out: dict[str, tuple[Field[Any], Any]] = {}
    for item in config.settable(cls):
        name, kind = f"{prefix}{item.name}", hints[item.name]
        if isinstance(kind, type) and is_dataclass(kind):
            out.update(_leaves(kind, f"{name}."))
        else:
            out[name] = item, kind
    return out


def _numeric(kind: Any) -> bool:
    return kind in (float, int) or any(map(_numeric, typing.get_args(kind)))


def descriptor(item: Field[Any], kind: Any, read_only: bool) -> ParameterDescriptor:
    """Return the descriptor that `ros2 param describe` shows: meaning, unit, range, options.

    Ranges of lists are only given as text, as ROS has no ranges for lists. An exclusive bound becomes the next number above it.
    """
    meta = item.metadata
    bound: Callable[[str], Any] = meta.get
    low, high, above = bound("low"), bound("high"), bound("above")
    optional = type(None) in typing.get_args(kind)
    kind = next(part for part in typing.get_args(kind) if part is not type(None)) if optional else kind
    out = ParameterDescriptor(description=meta.get("doc", ""), read_only=read_only, dynamic_typing=optional)
    unit = f"[{meta['unit']}]" if meta.get("unit") else ""
    entries = kind not in (float, int) and _numeric(kind)
    out.additional_constraints = ", ".join(part for part in (
        unit, f"> {above:g}" if above is not None and _numeric(kind) else "", f"one of {', '.join(meta['options'])}" if meta.get("options") else "",
        f"each >= {low:g}" if entries and low is not None else "", f"each <= {high:g}" if entries else "") if part)
    if kind is float and "high" in meta:
        least = float(low) if above is None else math.nextafter(above, math.inf)
        out.floating_point_range = [FloatingPointRange(from_value=least, to_value=float(high))]
    elif kind is int and "high" in meta:
        out.integer_range = [IntegerRange(from_value=int(low) if above is None else math.floor(above) + 1, to_value=int(high), step=1)]
    return out


def _plain(value: Any) -> Any:
    """Convert tuples, and the arrays that rclpy delivers for service requests, to lists."""
    return list(value) if isinstance(value, (tuple, array)) else value


def _value_at(instance: Any, name: str) -> Any:
    for part in name.split("."):
        instance = getattr(instance, part)
    return instance


class Parameters(typing.Generic[T]):
    """The parameters of a node. `.value` is the current frozen dataclass; it is replaced as a whole on every change."""

    def __init__(self, node: Node, cls: type[T], changeable: tuple[str, ...], on_change: Callable[[T], None]) -> None:
        """Declare every field of `cls` on `node` and read its overrides.

        Args:
            node: its name is the source in error messages.
            cls: configuration class (see perch_core.config); nested parts become dotted names.
            changeable: prefixes of the names that may change after the start; the others are read-only.
            on_change: called with the new value before it is set; an exception refuses it, and is raised to who sets it.

        Raises:
            ConfigError: an override is unknown, of the wrong type or out of range.
        """
        self._node, self._cls, self._on_change = node, cls, on_change
        self._leaves = _leaves(cls)
        overrides = {name: _plain(p.value) for name, p in node._parameter_overrides.items()}
        for name in overrides:
            if name not in self._leaves and name not in _FOREIGN and not node.has_parameter(name):
                raise config.unknown(node.get_name(), name, "parameter", self._leaves)
        self.value: T = config.from_mapping(
            cls, config.nested({n: v for n, v in overrides.items() if n in self._leaves}), node.get_name())
        for name, (item, kind) in self._leaves.items():
            fixed = not any(name.startswith(beginning) for beginning in changeable)
            node.declare_parameter(name, self._shown(name, kind, self.value), descriptor(item, kind, fixed), ignore_override=True)
        node.add_on_set_parameters_callback(self._set)

    def _shown(self, name: str, kind: Any, within: T) -> Any:
        """Return a value as ROS accepts it; an empty list needs an explicit type."""
        value = _plain(_value_at(within, name))
        if value == []:
            element = next((a for a in typing.get_args(kind) if isinstance(a, type)), str)
            empty = {float: Parameter.Type.DOUBLE_ARRAY, int: Parameter.Type.INTEGER_ARRAY}.get(element, Parameter.Type.STRING_ARRAY)
            return Parameter(name, empty, []).value
        return value

    def checked(self, changes: list[Parameter]) -> list[Parameter]:
        """Return the changes after checking them, with integers converted to real numbers where these are required.

        Raises:
            ConfigError: a parameter is unknown, of another type, or out of range; unlike rclpy's refusals, the error names it.
        """
        for change in changes:
            if change.name not in self._leaves and not self._node.has_parameter(change.name):
                raise config.unknown(self._node.get_name(), change.name, "parameter", self._leaves)
        value = self._changed(changes)
        return [Parameter(change.name, value=self._shown(change.name, self._leaves[change.name][1], value)) if change.name in self._leaves
                else change for change in changes]

    def _changed(self, changes: list[Parameter]) -> T:
        mine = {p.name: _plain(p.value) for p in changes if p.name in self._leaves}
        flat = {name: _plain(_value_at(self.value, name)) for name in self._leaves} | mine
        return config.from_mapping(self._cls, config.nested(flat), self._node.get_name())

    def _set(self, changes: list[Parameter]) -> SetParametersResult:
        if any(change.name in self._leaves for change in changes):
            value = self._changed(changes)
            self._on_change(value)
            self.value = value
        return SetParametersResult(successful=True)
