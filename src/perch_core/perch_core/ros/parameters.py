"""ROS parameters as a frozen dataclass: declared once with unit and range, refused when unknown or out of range."""

from __future__ import annotations

import typing
from array import array
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from perch_core import config
from perch_core.errors import ConfigError

T = TypeVar("T")

_FOREIGN = ("use_sim_time", "start_type_description_service", "qos_overrides.")


def _leaves(cls: type, prefix: str = "") -> dict[str, Any]:
    """Dotted name -> field of every parameter of a configuration class."""
    hints = typing.get_type_hints(cls)
    out = {}
    for item in fields(cls):
        name = f"{prefix}{item.name}"
        if is_dataclass(hints[item.name]):
            out.update(_leaves(hints[item.name], f"{name}."))
        else:
            out[name] = item
    return out


def _nest(flat: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, leaf = name.split(".")
        target = out
        for group in groups:
            target = target.setdefault(group, {})
        target[leaf] = value
    return out


def _describe(item: Any) -> str:
    meta = item.metadata
    unit = f" [{meta['unit']}]" if meta.get("unit") else ""
    span = "".join(f" {word} {meta[key]:g}" for key, word in (("above", ">"), ("low", ">="), ("high", "<="))
                   if meta.get(key) is not None)
    options = f" one of {', '.join(meta['options'])}" if meta.get("options") else ""
    return f"{meta.get('doc', '')}{unit}{span}{options}".strip()


def _plain(value: Any) -> Any:
    """Tuples, and the arrays in which rclpy hands over what came by service, as lists."""
    return list(value) if isinstance(value, (tuple, array)) else value


def _value_at(instance: Any, name: str) -> Any:
    for part in name.split("."):
        instance = getattr(instance, part)
    return instance


class Parameters(typing.Generic[T]):
    """The parameters of a node. `.value` is the present frozen dataclass; it is replaced as a whole on every change."""

    def __init__(self, node: Node, cls: type[T], on_change: typing.Callable[[T], None] | None = None) -> None:
        """Declare every field of `cls` on `node` and read its overrides.

        Args:
            node: its name is the source in error messages.
            cls: configuration class (see perch_core.config); nested parts become dotted names.
            on_change: called with the new value after an accepted `ros2 param set`; it may raise ConfigError to refuse.
                None: the parameters are fixed after the start.

        Raises:
            ConfigError: an override is unknown, of the wrong type or out of range.
        """
        self._node, self._cls, self._on_change = node, cls, on_change
        self._leaves = _leaves(cls)
        overrides = {name: p.value for name, p in node._parameter_overrides.items()}
        for name in overrides:
            if name not in self._leaves and not name.startswith(_FOREIGN):
                raise config.unknown(node.get_name(), name, "parameter", self._leaves)
        self.value: T = config.from_mapping(
            cls, _nest({n: v for n, v in overrides.items() if n in self._leaves}), node.get_name())
        for name, item in self._leaves.items():
            descriptor = ParameterDescriptor(description=_describe(item), dynamic_typing=True,
                                             read_only=on_change is None)
            node.declare_parameter(name, _plain(_value_at(self.value, name)), descriptor, ignore_override=True)
        node.add_on_set_parameters_callback(self._set)

    def _set(self, changes: list[Parameter]) -> SetParametersResult:
        mine = {p.name: _plain(p.value) for p in changes if p.name in self._leaves}
        if not mine:
            return SetParametersResult(successful=True)
        flat = {name: _plain(_value_at(self.value, name)) for name in self._leaves} | mine
        try:
            value = config.from_mapping(self._cls, _nest(flat), self._node.get_name())
            if self._on_change is not None:
                self._on_change(value)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.value = value
        return SetParametersResult(successful=True)
