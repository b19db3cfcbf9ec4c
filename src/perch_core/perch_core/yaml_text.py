"""Strict YAML parser with size limits: no file can crash its reader, occupy it for long, or be misread.

A file is first scanned as libyaml's events, so that excessive depth and size are refused before any value is built; an alias
counts as the values that it refers to. Scalars follow YAML 1.2 (`true`, `1e-3`; not `on`, not `1:30`), which includes JSON.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from yaml.events import AliasEvent, MappingStartEvent, NodeEvent, ScalarEvent, SequenceStartEvent

from perch_core.errors import ConfigError

BYTES_MAX = 1 << 20
DEPTH_MAX = 20
NODES_MAX = 20_000
ENTRIES_MAX = 2_000  # of a list or a mapping
INT_MAX = 2**63 - 1  # the largest integer


_Safe: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's, where there is one, is ten times as fast


class _Loader(_Safe):
    yaml_implicit_resolvers: dict[str, list[Any]] = {}


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    if len(node.value) > 20 or abs(int(node.value)) > INT_MAX:
        raise yaml.constructor.ConstructorError(None, None, "an integer beyond 64 bits", node.start_mark)
    return int(node.value)


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.0123456789")),
    ("merge", "<<", ["<"]),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def read_yaml(path: Path | str) -> Any:
    """Read a YAML file; see `parse_yaml`.

    Raises:
        ConfigError: the file cannot be read, or its content is refused.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(BYTES_MAX + 1)
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot be read: {error.strerror}") from None
    if len(content) > BYTES_MAX:
        raise ConfigError(str(path), "", f"has more than {BYTES_MAX} bytes")
    try:
        return parse_yaml(content.decode("utf-8"), str(path))
    except UnicodeDecodeError:
        raise ConfigError(str(path), "", "is not text in UTF-8") from None


def parse_yaml(text: str, source: str) -> Any:
    """Parse YAML into mappings, lists, text, numbers, booleans and None.

    Args:
        text: YAML or JSON.
        source: file or option, for messages.

    Raises:
        ConfigError: invalid YAML, a duplicate key, a tag, or content beyond the limits.
    """
    try:
        _scan(text, source)
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ConfigError(source, "", f"is not valid YAML: {error}") from None
    except UnicodeEncodeError:  # bytes of a command line that are no text
        raise ConfigError(source, "", "is not text in UTF-8") from None


class _OpenCollection:
    """A list or mapping whose end event has not been read."""

    def __init__(self, event: NodeEvent, before: int) -> None:
        self.anchor, self.before, self.height, self.entries = event.anchor, before, 1, 0
        self.keys: set[str] | None = set() if isinstance(event, MappingStartEvent) else None


def _scan(text: str, source: str) -> None:
    """Refuse duplicate keys, tags and excessive content before any value is built."""
    nodes = 0
    path: list[_OpenCollection] = []
    anchors: dict[str, tuple[int, int]] = {}  # name -> values, levels
    for event in yaml.parse(text, _Loader):
        def refuse(problem: str) -> None:
            raise ConfigError(source, f"line {event.start_mark.line + 1}", problem)  # noqa: B023 (called in this turn)

        if isinstance(event, NodeEvent):
            weight, height = 1, 0
            if isinstance(event, AliasEvent):
                if event.anchor not in anchors:
                    refuse(f"alias {event.anchor!r} has no anchor before it")
                weight, height = anchors[event.anchor]
            elif event.tag is not None:
                refuse(f"tag {event.tag!r}: tags are not used")
            elif isinstance(event, ScalarEvent) and event.anchor is not None:
                anchors[event.anchor] = 1, 0
            nodes += weight
            if nodes > NODES_MAX:
                refuse(f"more than {NODES_MAX} values")
            if len(path) + height > DEPTH_MAX:
                refuse(f"more than {DEPTH_MAX} levels")
            if path:
                parent = path[-1]
                if parent.keys is not None and parent.entries % 2 == 0:
                    if not isinstance(event, ScalarEvent):
                        refuse("a key that is not a scalar")
                    if event.value in parent.keys:
                        refuse(f"duplicate key {event.value!r}")
                    parent.keys.add(event.value)
                parent.entries += 1
                parent.height = max(parent.height, 1 + height)
                if parent.entries > ENTRIES_MAX:
                    refuse(f"more than {ENTRIES_MAX} entries")
            if isinstance(event, (MappingStartEvent, SequenceStartEvent)):
                path.append(_OpenCollection(event, nodes - 1))
                if len(path) > DEPTH_MAX:
                    refuse(f"more than {DEPTH_MAX} levels")
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            done = path.pop()
            if done.anchor is not None:
                anchors[done.anchor] = nodes - done.before, done.height
            if path:
                path[-1].height = max(path[-1].height, 1 + done.height)
