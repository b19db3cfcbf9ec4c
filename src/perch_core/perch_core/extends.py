"""YAML files that extend each other: `extends: line_80` inherits every key that the file itself does not set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from perch_core import config
from perch_core.errors import ConfigError

EXTENDS = "extends"
PARAMETERS = "parameters"  # of nodes, in scenarios
CHAIN_MAX = 10
FILES = {"scenarios": ("vehicle", "target.board")}
"""Folder in `config` -> keys of its files whose values are names or files: paths are relative to the folder of the file that has them."""


def extended_mapping(kind: str, name_or_path: str | Path) -> dict[str, Any]:
    """Return the content of a file merged over all files that it extends: mappings key by key, other values replaced.

    Parameters of nodes have dotted names, whichever way the files write them. Paths to vehicles and boards are absolute.

    Args:
        kind: folder in `config`.
        name_or_path: a name in that folder, or a file. The same holds for the value of `extends`; its path is relative to the
            folder of the file that extends it.

    Raises:
        ConfigError: no such file, a file that is no mapping, or a cycle of files; the message names the chain of files.
    """
    return _load_merged(kind, config.find(kind, name_or_path), ())


def _load_merged(kind: str, path: Path, chain: tuple[Path, ...]) -> dict[str, Any]:
    source = " extends ".join(str(file) for file in (*chain, path))
    if path.resolve() in (file.resolve() for file in chain):
        raise ConfigError(source, EXTENDS, "the files extend each other in a circle")
    if len(chain) == CHAIN_MAX:
        raise ConfigError(source, EXTENDS, f"more than {CHAIN_MAX} files extend each other")
    content = config.read_yaml(path) or {}
    if not isinstance(content, dict):
        raise ConfigError(source, "", f"{content!r} is not a mapping")
    if isinstance(content.get(PARAMETERS), dict):  # dotted or nested: one spelling, so that a file's values replace those of its base
        content[PARAMETERS] = {node: config.flattened(values) if isinstance(values, dict) else values
                               for node, values in content[PARAMETERS].items()}
    for key in FILES.get(kind, ()):
        *groups, leaf = key.split(".")
        place: Any = content
        for group in groups:
            place = place.get(group) if isinstance(place, dict) else None
        if isinstance(place, dict) and leaf in place:
            place[leaf] = config.beside(path, place[leaf])
    if EXTENDS not in content:
        return content
    base = content.pop(EXTENDS)
    if not isinstance(base, str):
        raise ConfigError(source, EXTENDS, f"{base!r} is neither a name in config/{kind} nor a file")
    try:
        found = config.find(kind, path.parent / base if base.endswith((".yaml", ".yml")) else base)
    except ConfigError as error:
        raise ConfigError(source, EXTENDS, str(error)) from None
    return _merge(_load_merged(kind, found, (*chain, path)), content)


def _merge(base: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `content` merged over it."""
    out = dict(base)
    for key, value in content.items():
        inner = out.get(key)
        out[key] = _merge(inner, value) if isinstance(inner, dict) and isinstance(value, dict) else value
    return out
