"""Strict conversion of YAML files to frozen dataclasses: unknown keys, wrong types and values out of range are refused.

A configuration class is a frozen dataclass whose fields are declared with `quantity`, `text`, `vector` or `part`;
the declaration defines unit, range and meaning once, for files, ROS parameters and the documentation.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import os
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from perch_core.errors import ConfigError
from perch_core.yaml_text import parse_yaml as parse_yaml, read_yaml as read_yaml

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
DEFAULT_BOUNDS = {"m": 1e4, "m/s": 100.0, "m/s^2": 1e3, "m/s^3": 1e5, "rad": 1e3, "rad/s": 1e4, "rad/s^2": 1e4, "deg": 360.0, "s": 3600.0, "Hz": 1e4,
           "kg": 50.0, "kg m^2": 10.0, "N": 1e3, "N/s": 1e5, "N s/m": 100.0, "N s^2/rad^2": 1e-2, "px": 1e4}
"""Default bound on the magnitude of a quantity, by unit; far beyond the values of any supported vehicle."""
FALLBACK_BOUND = 1e6
"""Default bound on the magnitude of every other number."""
TEXT_LENGTH_MAX = 2000
NAME = re.compile(r"\w[\w .+-]{0,99}")
"""Pattern of names that are used for folders, files or topics."""


def quantity(default: Any = MISSING, *, unit: str = "", low: float | None = None, high: float | None = None,
             doc: str = "", above: float | None = None) -> Any:
    """Declare a number (or tuple of numbers) with unit and range; `low`/`high` are inclusive, `above` is exclusive.

    A missing bound is taken from `DEFAULT_BOUNDS`.
    """
    largest = DEFAULT_BOUNDS.get(unit, FALLBACK_BOUND)
    low, high = -largest if low is None and above is None else low, largest if high is None else high
    return field(default=default, metadata={"unit": unit, "low": low, "high": high, "above": above, "doc": doc})


def choice(default: Any = MISSING, *, options: tuple[str, ...], doc: str = "") -> Any:
    """Declare a word out of `options`."""
    return field(default=default, metadata={"options": options, "doc": doc})


def text(default: Any = MISSING, *, doc: str = "") -> Any:
    """Declare a free string (a path, a name)."""
    return field(default=default, metadata={"doc": doc})


def label(default: Any = MISSING) -> Any:
    """Declare a name that is used for folders, files or topics: no separators, no control characters."""
    return field(default=default, metadata={"label": True})


def part(cls: type, *, doc: str = "") -> Any:
    """Declare a nested configuration that may be omitted; its own defaults then apply."""
    return field(default_factory=cls, metadata={"doc": doc})


def derived(default: Any) -> Any:
    """Declare a field that follows from others, as from a file that one of them names: no key of a file, and no ROS parameter."""
    return field(default=default, metadata={"derived": True})


def settable(cls: type[DataclassInstance]) -> list[Field[Any]]:
    """Return the fields of a configuration class that a file or a parameter may set."""
    return [item for item in fields(cls) if item.init and "derived" not in item.metadata]


def check(source: str, key: str, item: Field[Any], value: Any) -> None:
    """Check a value against its declaration: range, options, length of text, form of a name.

    Raises:
        ConfigError: it is not allowed; the message has the value and what is allowed.
    """
    meta = item.metadata
    options = meta.get("options")
    if options is not None and value not in options:
        raise ConfigError(source, key, f"{value!r} is not one of {', '.join(options)}")
    if isinstance(value, str) and (len(value) > TEXT_LENGTH_MAX or not "".join(value.split()).isprintable()):
        raise ConfigError(source, key, f"{value!r} is not text of up to {TEXT_LENGTH_MAX} printable characters")
    if meta.get("label") and not NAME.fullmatch(value):
        raise ConfigError(source, key, f"{value!r} is no name: up to 100 letters, digits and any of ' _.+-' after the first")
    low, high, above = meta.get("low", -FALLBACK_BOUND), meta.get("high", FALLBACK_BOUND), meta.get("above")
    for number in _numbers(value):
        if number != item.default and not (number <= high and (number >= low if above is None else number > above)):
            span = f"{f'[{low:g}' if above is None else f'({above:g}'}, {high:g}] {meta.get('unit', '')}".rstrip()
            raise ConfigError(source, key, f"{number:g} is outside {span}")


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers of a value and of nested tuples; nested dataclasses have been checked already."""
    if isinstance(value, (tuple, list)):
        for entry in value:
            yield from _numbers(entry)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value


def _convert(kind: Any, value: Any, source: str, key: str) -> Any:
    """Convert a YAML value to the type of a field, strictly."""
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        kind = next(arg for arg in typing.get_args(kind) if arg is not type(None))
        return _convert(kind, value, source, key)
    if isinstance(kind, type) and is_dataclass(kind):
        return from_mapping(kind, value, source, key)
    if origin is dict:
        if not isinstance(value, dict):
            raise ConfigError(source, key, f"{value!r} is not a mapping")
        _, item = typing.get_args(kind)
        for k in value:
            if not (isinstance(k, str) and NAME.fullmatch(k)):
                raise ConfigError(source, key, f"{k!r} is no name")
        return {k: _convert(item, v, source, f"{key}.{k}") for k, v in value.items()}
    if origin is tuple:
        args = typing.get_args(kind)
        if not isinstance(value, (list, tuple)):
            raise ConfigError(source, key, f"{value!r} is not a list")
        if args[-1] is Ellipsis:
            return tuple(_convert(args[0], v, source, f"{key}[{i}]") for i, v in enumerate(value))
        if len(value) != len(args):
            raise ConfigError(source, key, f"has {len(value)} entries, needs {len(args)}")
        return tuple(_convert(a, v, source, f"{key}[{i}]") for i, (a, v) in enumerate(zip(args, value)))
    if kind is Any:
        return value
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if kind in (int, bool, str) and type(value) is kind:
        return value
    raise ConfigError(source, key, f"{value!r} is not of type {getattr(kind, '__name__', kind)}")


def unknown(source: str, key: str, kind: str, names: Iterable[str]) -> ConfigError:
    """Return the error for an unknown name; it lists the valid names, or where there are many those that are spelled
    alike or have a word in common, or their groups."""
    names = list(names)
    words = set(re.findall("[a-z]{3,}", key)) - {"max", "min"}
    related = [name for name in names if words & set(re.findall("[a-z]{3,}", name))]
    close = list(dict.fromkeys(difflib.get_close_matches(key, names, 5) + difflib.get_close_matches(key, related, 5, cutoff=0.0)))[:5]
    groups = list(dict.fromkeys(name.split(".")[0] for name in names))
    if len(names) <= 16 or not close and len(groups) == len(names):
        hint = f"allowed: {', '.join(names)}"
    else:
        hint = f"did you mean {', '.join(close)}?" if close else f"the {len(names)} names begin with {', '.join(groups)}"
    return ConfigError(source, key, f"unknown {kind}; {hint}")


def from_mapping(cls: type[T], mapping: Any, source: str, prefix: str = "") -> T:
    """Build a frozen dataclass from a parsed YAML mapping.

    Args:
        cls: frozen dataclass.
        mapping: content of the YAML file at `prefix`.
        source: file name (or node name), for messages.
        prefix: key of the mapping inside its file, for messages.

    Raises:
        ConfigError: unknown or missing key, wrong type, value out of range.
    """
    if not isinstance(mapping, dict):
        raise ConfigError(source, prefix, f"{mapping!r} is not a mapping")
    hints = _hints(cls)
    known = {item.name: item for item in settable(cls)}
    dot = f"{prefix}." if prefix else ""
    for key in mapping:
        if key not in known:
            raise unknown(source, f"{dot}{key}", "key", known)
    values = {}
    for name, item in known.items():
        if name not in mapping:
            if item.default is MISSING and item.default_factory is MISSING:
                raise ConfigError(source, f"{dot}{name}", "missing; it has no default")
            continue
        values[name] = _convert(hints[name], mapping[name], source, f"{dot}{name}")
        check(source, f"{dot}{name}", item, values[name])
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(source, f"{dot}{error.key}", error.problem) from None


@functools.cache
def _hints(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def load(cls: type[T], path: Path | str) -> T:
    """Read a YAML file into a frozen dataclass, strictly. See `from_mapping`."""
    return from_mapping(cls, read_yaml(path) or {}, str(path))


def nested(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Convert dotted names to nested mappings."""
    out: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, leaf = name.split(".")
        place = out
        for group in groups:
            place = place.setdefault(group, {})
            if not isinstance(place, dict):
                raise ConfigError("", name, f"{group!r} is a value, not a group")
        if isinstance(place.get(leaf), dict):
            raise ConfigError("", name, f"{leaf!r} is a group, not a value")
        place[leaf] = value
    return out


def flattened(parameters: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Convert nested parameters to dotted names, so that later ones replace single values."""
    flat: dict[str, Any] = {}
    for key, value in parameters.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = list(value) if isinstance(value, tuple) else value
    return flat


def config_dir() -> Path:
    """Return the folder with `vehicles/`, `scenarios/`, `boards/`: $PERCH_CONFIG_DIR, or that of the checkout or installation."""
    if given := os.environ.get("PERCH_CONFIG_DIR"):
        if not os.path.isdir(given):
            raise ConfigError("PERCH_CONFIG_DIR", given, "no such folder")
        return Path(given)
    for folder in Path(__file__).resolve().parents:
        for candidate in (folder / "config", folder / "share" / "perch_core" / "config"):
            if (candidate / "vehicles").is_dir():
                return candidate.resolve()
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        candidate = Path(prefix) / "share" / "perch_core" / "config"
        if candidate.is_dir():
            return candidate
    raise ConfigError("config", "", "no configuration folder found; set PERCH_CONFIG_DIR")


def find(kind: str, name_or_path: str | Path) -> Path:
    """Return `config/<kind>/<name>.yaml`, or the path itself where it ends in `.yaml` or `.yml`.

    Raises:
        ConfigError: no such file; for a name, the message lists the available ones.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        if os.path.isfile(path):
            return path
        raise ConfigError(str(path), "", "no such file")
    folder = config_dir() / kind
    candidate = folder / f"{name_or_path}.yaml"
    if NAME.fullmatch(str(name_or_path)) and candidate.is_file():
        return candidate
    names = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
    raise ConfigError(kind, str(name_or_path), f"unknown; there are: {names}" if names else f"unknown; there are none in {folder}")


def beside(file: str | Path, name_or_path: Any) -> Any:
    """Return what a file names: a path, relative to the folder of the file (or, if there is none, to the current one), as an
    absolute path; a name, and a path to no file, unchanged."""
    if isinstance(name_or_path, str) and name_or_path.endswith((".yaml", ".yml")):
        for path in (os.path.join(os.path.dirname(file), name_or_path), name_or_path):
            if os.path.isfile(path):
                return os.path.abspath(path)
    return name_or_path


def replace(instance: T, **changes: Any) -> T:
    """`dataclasses.replace` with the range checks of the fields."""
    for item in fields(instance):
        if item.name in changes:
            check(type(instance).__name__, item.name, item, changes[item.name])
    return dataclasses.replace(instance, **changes)
