"""Distributions of varied quantities: choice, uniform, normal, or grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from perch_core.config import LARGEST_NUMBER
from perch_core.errors import ConfigError

LARGEST_SEED = 2**31 - 1
KINDS = ("choice", "uniform", "normal", "grid")


@dataclass(frozen=True)
class Distribution:
    """Distribution of one varied quantity.

    Attributes:
        kind: one of `KINDS`.
        values: choices, grid values, (low, high) of a uniform, or (mean, sigma) of a normal distribution.
        low, high: limits of a normal distribution; values outside are drawn again.
    """

    kind: str
    values: tuple[Any, ...]
    low: float = -np.inf
    high: float = np.inf

    def __str__(self) -> str:
        limits = f", within [{self.low:g}, {self.high:g}]" if np.isfinite([self.low, self.high]).any() else ""
        return f"{self.kind} {list(self.values)}{limits}"

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw one value; not for grids, whose values are all flown."""
        if self.kind == "choice":
            return self.values[int(rng.integers(len(self.values)))]
        if self.kind == "uniform":
            return float(rng.uniform(*self.values))
        for _ in range(1000):
            value = float(rng.normal(*self.values))
            if self.low <= value <= self.high:
                return value
        raise ConfigError("campaign", "normal", f"[{self.low:g}, {self.high:g}] is hardly ever met by normal{self.values}")


def parse(source: str, key: str, entry: Any) -> Distribution:
    """Parse a distribution from an entry of a campaign file such as `{uniform: [0.8, 3.0]}`.

    Raises:
        ConfigError: the entry is not a valid distribution.
    """
    if not isinstance(entry, Mapping):
        raise ConfigError(source, key, f"{entry!r} is not a mapping such as {{uniform: [0.8, 3.0]}}")
    kinds = [kind for kind in KINDS if kind in entry]
    extra = set(entry) - set(KINDS) - ({"low", "high"} if kinds == ["normal"] else set())
    if len(kinds) != 1 or extra:
        raise ConfigError(source, key, f"{dict(entry)!r} needs exactly one of {', '.join(KINDS)}"
                          " (normal may have low and high)")
    kind, values = kinds[0], entry[kinds[0]]
    if not isinstance(values, list) or not values:
        raise ConfigError(source, f"{key}.{kind}", f"{values!r} is not a list")
    if len({_sort(v) for v in values}) > 1 or "" in map(_sort, values):
        raise ConfigError(source, f"{key}.{kind}", f"{values!r} are not all numbers (of at most {LARGEST_NUMBER:g}), words, true or false, or vectors")
    if kind in ("uniform", "normal"):
        if len(values) != 2 or not all(_is_number(v) for v in values):
            raise ConfigError(source, f"{key}.{kind}", f"{values!r} is not two numbers of at most {LARGEST_NUMBER:g}")
        if kind == "uniform" and not values[0] < values[1]:
            raise ConfigError(source, f"{key}.uniform", f"{values[0]} is not below {values[1]}")
        if kind == "normal" and not values[1] > 0:
            raise ConfigError(source, f"{key}.normal", f"sigma {values[1]} is not > 0")
    limits = {name: entry[name] for name in ("low", "high") if name in entry}
    for name, value in limits.items():
        if not _is_number(value):
            raise ConfigError(source, f"{key}.{name}", f"{value!r} is not a number of at most {LARGEST_NUMBER:g}")
    return Distribution(kind, tuple(tuple(v) if isinstance(v, list) else v for v in values), **limits)


def parse_seed(source: str, key: str, entry: Any) -> Distribution:
    """Parse the distribution of the flights' seeds: a grid or a choice.

    Raises:
        ConfigError: another distribution, or values other than integers in the range of seeds.
    """
    found = parse(source, key, entry)
    if found.kind not in ("grid", "choice") or not all(type(v) is int and 0 <= v <= LARGEST_SEED for v in found.values):
        raise ConfigError(source, key, f"{entry!r} is not a grid or choice of whole numbers in [0, {LARGEST_SEED}]")
    return found


def _sort(value: Any) -> str:
    """Return the kind of a value, which all values of a quantity must share; empty: the value is not permitted."""
    if isinstance(value, list):
        return f"{len(value)} numbers" if value and all(map(_is_number, value)) else ""
    return "number" if _is_number(value) else type(value).__name__ if isinstance(value, (str, bool)) else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER
