"""YAML files that extend each other: `extends: line_80` inherits every key that the file itself does not set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from perch_core import config
from perch_core.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
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
    return _merged(_read_chain(kind, name_or_path))


def load_extended(cls: type[T], kind: str, name_or_path: str | Path) -> T:
    """Return the frozen dataclass of `extended_mapping`.

    Raises:
        ConfigError: as `extended_mapping`, or a value is refused; the message names the chain of files, one of which has it.
    """
    files = _read_chain(kind, name_or_path)
    return config.from_mapping(cls, _merged(files), _chain(files))


def _chain(files: Iterable[Path]) -> str:
    return " extends ".join(map(str, files))


def _merged(files: dict[Path, dict[str, Any]]) -> dict[str, Any]:
    merged: dict[str, Any] = {}
    for content in reversed(files.values()):
        merged = _merge(merged, content)
    return merged


def _read_chain(kind: str, name_or_path: str | Path) -> dict[Path, dict[str, Any]]:
    """Return the contents of a file and of all files that it extends, in this order."""
    path, files = config.find(kind, name_or_path), dict[Path, dict[str, Any]]()
    while True:
        source = _chain((*files, path))
        if path.resolve() in (file.resolve() for file in files):
            raise ConfigError(source, EXTENDS, "the files extend each other in a circle")
        if len(files) == CHAIN_MAX:
            raise ConfigError(source, EXTENDS, f"more than {CHAIN_MAX} files extend each other")
        content = config.read_yaml(path) or {}
        if not isinstance(content, dict):
            raise ConfigError(source, "", f"{content!r} is not a mapping")
        files[path] = content
        _normalise(kind, path, content)
        if EXTENDS not in content:
            return files
        base = content.pop(EXTENDS)
        if not isinstance(base, str):
            raise ConfigError(source, EXTENDS, f"{base!r} is neither a name in config/{kind} nor a file")
        try:
            path = config.find(kind, path.parent / base if base.endswith((".yaml", ".yml")) else base)
        except ConfigError as error:
            raise ConfigError(source, EXTENDS, str(error)) from None


def _normalise(kind: str, path: Path, content: dict[str, Any]) -> None:
    """Give parameters dotted names, so that a file's values replace those of its base, and make paths absolute."""
    if isinstance(content.get(PARAMETERS), dict):
        content[PARAMETERS] = {node: config.flattened(values) if isinstance(values, dict) else values
                               for node, values in content[PARAMETERS].items()}
    for key in FILES.get(kind, ()):
        *groups, leaf = key.split(".")
        place: Any = content
        for group in groups:
            place = place.get(group) if isinstance(place, dict) else None
        if isinstance(place, dict) and leaf in place:
            place[leaf] = config.beside(path, place[leaf])


def _merge(base: Mapping[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `content` merged over it."""
    out = dict(base)
    for key, value in content.items():
        inner = out.get(key)
        out[key] = _merge(inner, value) if isinstance(inner, dict) and isinstance(value, dict) else value
    return out
