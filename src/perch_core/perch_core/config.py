"""YAML files into frozen dataclasses, strictly: unknown keys, wrong types and values out of range are refused.

A configuration class is a frozen dataclass whose fields are declared with `quantity`, `text`, `vector` or `part`;
the declaration holds unit, range and meaning once, for files, ROS parameters and the documentation.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
import types
import typing
from collections.abc import Iterable
from dataclasses import MISSING, Field, field, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

from perch_core.errors import ConfigError

T = TypeVar("T")
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's, where there is one, is ten times as fast


def quantity(default: Any = MISSING, *, unit: str = "", low: float | None = None, high: float | None = None,
             doc: str = "", above: float | None = None) -> Any:
    """A number (or tuple of numbers) with unit and range; `low`/`high` are inclusive, `above` is exclusive."""
    return field(default=default, metadata={"unit": unit, "low": low, "high": high, "above": above, "doc": doc})


def choice(default: Any = MISSING, *, options: tuple[str, ...], doc: str = "") -> Any:
    """A word out of `options`."""
    return field(default=default, metadata={"options": options, "doc": doc})


def text(default: Any = MISSING, *, doc: str = "") -> Any:
    """A free string (a path, a name)."""
    return field(default=default, metadata={"doc": doc})


def part(cls: type, *, doc: str = "") -> Any:
    """A nested configuration that may be left out: its own defaults then count."""
    return field(default_factory=cls, metadata={"doc": doc})


def check(source: str, key: str, item: Field, value: Any) -> None:
    """Refuse a number out of the declared range, or a word that is no option.

    Raises:
        ConfigError: with the value and its allowed range.
    """
    meta = item.metadata
    options = meta.get("options")
    if options is not None and value not in options:
        raise ConfigError(source, key, f"{value!r} is not one of {', '.join(options)}")
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, (int, float)):
            continue
        unit = f" {meta['unit']}" if meta.get("unit") else ""
        if math.isnan(number):
            raise ConfigError(source, key, "nan is not a number")
        if math.isinf(number) and item.default != number:
            raise ConfigError(source, key, f"{number} is not finite")
        low, high, above = meta.get("low"), meta.get("high"), meta.get("above")
        if above is not None and high is None and not number > above:
            raise ConfigError(source, key, f"{number:g} is not > {above:g}{unit}")
        if (low is not None and number < low) or (high is not None and number > high) or (above is not None and not number > above):
            begin = f"({above:g}" if above is not None else "[-inf" if low is None else f"[{low:g}"
            span = f"{begin}, {'inf' if high is None else format(high, 'g')}]"
            raise ConfigError(source, key, f"{number:g} is outside {span}{unit}")


def _convert(kind: Any, value: Any, source: str, key: str) -> Any:
    """Bring a YAML value to the type of a field, without guessing."""
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        kind = next(arg for arg in typing.get_args(kind) if arg is not type(None))
        return _convert(kind, value, source, key)
    if is_dataclass(kind):
        return from_mapping(kind, value, source, key)
    if origin is dict:
        if not isinstance(value, dict):
            raise ConfigError(source, key, f"{value!r} is not a mapping")
        _, item = typing.get_args(kind)
        return {str(k): _convert(item, v, source, f"{key}.{k}") for k, v in value.items()}
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
    """The error for a name that does not exist: it lists the names there are, or the likeliest of many."""
    names = list(names)
    close = difflib.get_close_matches(key, names, n=5, cutoff=0.4)
    if len(names) <= 16:
        return ConfigError(source, key, f"unknown {kind}; allowed: {', '.join(names)}")
    hint = f"did you mean {', '.join(close)}?" if close else f"the {len(names)} names begin with {', '.join(dict.fromkeys(n.split('.')[0] for n in names))}"
    return ConfigError(source, key, f"unknown {kind}; {hint}")


def from_mapping(cls: type[T], mapping: Any, source: str, prefix: str = "") -> T:
    """A frozen dataclass from a parsed YAML mapping.

    Args:
        cls: frozen dataclass.
        mapping: what the YAML file holds at `prefix`.
        source: file name (or node name), for messages.
        prefix: key of the mapping inside its file, for messages.

    Raises:
        ConfigError: unknown or missing key, wrong type, value out of range.
    """
    if not isinstance(mapping, dict):
        raise ConfigError(source, prefix, f"{mapping!r} is not a mapping")
    hints = typing.get_type_hints(cls)
    known = {f.name: f for f in fields(cls) if f.init}
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


def read_yaml(path: Path | str) -> Any:
    """Parsed YAML of a file.

    Raises:
        ConfigError: the file is missing or is not YAML.
    """
    try:
        return yaml.load(Path(path).read_text(encoding="utf-8"), _LOADER)
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot be read: {error.strerror}") from None
    except yaml.YAMLError as error:
        raise ConfigError(str(path), "", f"is not valid YAML: {' '.join(str(error).split())}") from None
    except UnicodeDecodeError:
        raise ConfigError(str(path), "", "is not text in UTF-8") from None


def load(cls: type[T], path: Path | str) -> T:
    """Read a YAML file into a frozen dataclass, strictly. See `from_mapping`."""
    return from_mapping(cls, read_yaml(path) or {}, str(path))


def config_dir() -> Path:
    """The folder that holds `vehicles/`, `scenarios/`, `boards/`: $PERCH_CONFIG_DIR, the checkout, or the install."""
    if os.environ.get("PERCH_CONFIG_DIR"):
        return Path(os.environ["PERCH_CONFIG_DIR"])
    for folder in Path(__file__).resolve().parents:
        for candidate in (folder / "config", folder / "share" / "perch_core" / "config"):
            if (candidate / "vehicles").is_dir():
                return candidate
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        candidate = Path(prefix) / "share" / "perch_core" / "config"
        if candidate.is_dir():
            return candidate
    raise ConfigError("config", "", "no configuration folder found; set PERCH_CONFIG_DIR")


def find(kind: str, name_or_path: str | Path) -> Path:
    """`config/<kind>/<name>.yaml`, or the path itself when it names a file.

    Raises:
        ConfigError: no such file; the message lists the names there are.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml"):
        if path.is_file():
            return path
        raise ConfigError(str(path), "", "no such file")
    folder = config_dir() / kind
    candidate = folder / f"{name_or_path}.yaml"
    if candidate.is_file():
        return candidate
    names = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
    raise ConfigError(kind, str(name_or_path), f"unknown; there are: {names}")


def replace(instance: T, **changes: Any) -> T:
    """`dataclasses.replace` with the range checks of the fields."""
    for item in fields(instance):
        if item.name in changes:
            check(type(instance).__name__, item.name, item, changes[item.name])
    return dataclasses.replace(instance, **changes)
