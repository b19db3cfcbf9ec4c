"""Specification of a campaign: a scenario, distributions of varied quantities, number of runs; a file in `config/campaigns/`.

A varied name is a field of the scenario (`target.distance`, `wind.gust_sigma`), an entry of one of its vectors
(`wind.steady.0`), or a node's parameter (`parameters.controller.gains.lead`). `seed` can be varied, too, by a grid or a choice.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import config
from perch_core.config import FALLBACK_BOUND, choice, label, part, quantity, text
from perch_core.errors import ConfigError
from perch_core.extends import FILES, extended_mapping
from perch_core.vehicle import Vehicle
from perch_eval.flyable import check_flight, check_names
from perch_eval.in_process import Sensing
from perch_eval.in_process.parameters import check_parameters
from perch_sim.scenario import Scenario

LARGEST_SEED = 2**31 - 1
RUNS_MAX = 20_000
"""Largest number of runs of a campaign, over all points of its grids."""
KINDS = ("choice", "uniform", "normal", "grid")
_DEFAULTS = config.flattened(asdict(Scenario(name="defaults")))


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
        raise ConfigError("campaign", "normal", f"[{self.low:g}, {self.high:g}] is almost never drawn by normal{self.values}")


@dataclass(frozen=True, kw_only=True)
class _File:
    """Content of a campaign file."""

    name: str = label()
    description: str = text("")
    scenario: str = text("surface_90", doc="name in config/scenarios, or a file")
    engine: str = choice("in_process", options=("in_process", "stack"))
    sensing: Sensing = part(Sensing)
    runs: int = quantity(100, low=1, high=RUNS_MAX, doc="flights; with grids: flights per grid point")
    seed: int = quantity(1, low=0, high=LARGEST_SEED, doc="of the campaign: draws and the flights' seeds come from it")
    vary: dict[str, Any] = text(None, doc="name -> distribution")
    map: tuple[str, ...] = quantity((), doc="two varied names: axes of the success map")
    keep_worst: int = quantity(5, low=0, high=100, doc="flights whose full reports are kept")


@dataclass(frozen=True)
class Run:
    """One flight of a campaign."""

    number: int
    seed: int
    values: dict[str, Any]


@dataclass(frozen=True)
class Campaign:
    """Checked campaign: the scenario of every run is valid.

    Attributes:
        name, description, engine, sensing, keep_worst: as in the file, the engine unless replaced.
        axes: varied names on the axes of the success map; empty: there is no map.
        base: the scenario's mapping, before the variation.
        vary: varied name -> distribution.
        runs: runs to be flown.
        digest: SHA-256 of the settings: engine, runs, and the resolved files of scenario, vehicles and tag boards.
        file: its file, to whose folder paths are relative.
    """

    name: str
    description: str
    engine: str
    sensing: Sensing
    axes: tuple[str, ...]
    keep_worst: int
    base: dict[str, Any]
    vary: dict[str, Distribution]
    runs: tuple[Run, ...]
    digest: str
    file: Path

    def mapping(self, run: Run) -> dict[str, Any]:
        """Return the scenario's mapping for a run, in the form of a scenario file."""
        flat = config.flattened(self.base)
        for name, value in run.values.items():
            name, value = _field(flat, name, config.beside(self.file, value) if name in FILES["scenarios"] else value)
            flat[name] = list(value) if isinstance(value, tuple) else value
        try:
            return config.nested(flat)
        except ConfigError as error:
            raise ConfigError(str(self.file), f"vary.{error.key}", error.problem) from None


def load_campaign(path: Path | str, engine: str | None = None, runs: int | None = None) -> Campaign:
    """Read a campaign's file and draw its runs.

    Args:
        path: name in `config/campaigns`, or a file.
        engine: replaces the engine of the file.
        runs: replaces the number of runs of the file.

    Raises:
        ConfigError: the file, a distribution, or a drawn scenario is invalid.
    """
    file = config.find("campaigns", path)
    content = config.load(_File, file)
    base = extended_mapping("scenarios", config.beside(file, content.scenario))
    vary = {name: (parse_seed if name == "seed" else parse_distribution)(str(file), f"vary.{name}", entry)
            for name, entry in (content.vary or {}).items()}
    mappable = [name for name in vary if name != "seed"]  # one run a seed: no rate
    for axis in content.map:
        if axis not in mappable:
            raise ConfigError(str(file), "map", f"{axis!r} is not varied; varied: {', '.join(mappable) or 'nothing'}")
    if len(content.map) not in (0, 2):
        raise ConfigError(str(file), "map", f"needs two names, has {len(content.map)}")
    engine = engine or content.engine
    flights = math.prod([runs or content.runs, *(len(d.values) for d in vary.values() if d.kind == "grid")])
    if flights > RUNS_MAX:
        raise ConfigError(str(file), "runs", f"{flights} flights on all points of the grids are more than {RUNS_MAX}")
    drawn = _draw(vary, runs or content.runs, content.seed)
    axes = content.map or tuple(mappable[:2])
    campaign = Campaign(content.name, content.description, engine, content.sensing, axes if len(axes) == 2 else (),
                        content.keep_worst, base, vary, drawn, "", file)
    named = _check(campaign, str(file))
    settings = json.dumps([engine, asdict(content.sensing), base, [[r.number, r.seed, r.values] for r in drawn], named], sort_keys=True, default=str)
    return replace(campaign, digest=hashlib.sha256(settings.encode()).hexdigest())


def _check(campaign: Campaign, file: str) -> list[dict[str, Any]]:
    """Check that every run can be flown: its scenario, the files named there, and the nodes' parameters.

    Returns:
        The content of these vehicle and board files.

    Raises:
        ConfigError: a run cannot be flown; the message contains its number and values.
    """
    vehicles: dict[tuple[str, ...], Vehicle] = {}
    parameters: dict[str, Any] = {}
    different = {json.dumps(run.values): run for run in reversed(campaign.runs)}
    for run in sorted(different.values(), key=lambda run: run.number):
        source = f"{file}: run {run.number} ({values_text(run.values)})"
        scenario = config.from_mapping(Scenario, campaign.mapping(run), source)
        names = scenario.vehicle, scenario.target.board, scenario.mission_type
        if names not in vehicles:
            vehicles[names] = check_names(scenario, source)
        if campaign.engine == "stack":
            check_flight(scenario, source, vehicles[names])
        if scenario.parameters != parameters:
            check_parameters(scenario, source)
            parameters = scenario.parameters
    return [extended_mapping("vehicles", vehicle) | {"board": config.read_yaml(config.find("boards", board))} for vehicle, board, _ in vehicles]


def _field(flat: Mapping[str, Any], name: str, value: Any) -> tuple[str, Any]:
    """Return name and value of the scenario field that a varied name sets: itself, or the vector of an entry. `flat`: dotted names."""
    vector, _, index = name.rpartition(".")
    if not (index.isascii() and index.isdigit()) or name.startswith("parameters."):
        return name, value
    entries = flat.get(vector, _DEFAULTS.get(vector))
    if not isinstance(entries, list):
        raise ConfigError("campaign", f"vary.{name}", f"{vector.rpartition('.')[2]} is not a vector")
    if int(index) >= len(entries):
        raise ConfigError("campaign", f"vary.{name}", f"{vector.rpartition('.')[2]} has {len(entries)} entries")
    return vector, [*entries[:int(index)], value, *entries[int(index) + 1:]]


def _draw(vary: Mapping[str, Distribution], runs: int, seed: int) -> tuple[Run, ...]:
    """Draw the runs: all grid points with the same `runs` draws of the other quantities, so that points are comparable.

    The k-th draw does not depend on the number of draws, nor its flight's seed on which quantities are varied.

    Raises:
        ConfigError: two flights would be identical.
    """
    grids = {name: d.values for name, d in vary.items() if d.kind == "grid"}
    points = [dict(zip(grids, point)) for point in itertools.product(*grids.values())]
    out = []
    for number in range(runs * len(points)):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number // len(points),)))
        drawn_seed = int(rng.integers(1, LARGEST_SEED))
        values = {name: d.draw(rng) for name, d in vary.items() if d.kind != "grid"}
        values |= points[number % len(points)]
        out.append(Run(number, int(values.pop("seed", drawn_seed)), values))
    different = len({(run.seed, json.dumps(run.values)) for run in out})
    if different < len(out):
        raise ConfigError("campaign", "runs", f"only {different} of {len(out)} flights differ: fly fewer, or do not vary `seed`")
    return tuple(out)


def values_text(values: Mapping[str, Any]) -> str:
    """Return varied values as text."""
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())


def parse_distribution(source: str, key: str, entry: Any) -> Distribution:
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
    if len({_kind(v) for v in values}) > 1 or "" in map(_kind, values):
        raise ConfigError(source, f"{key}.{kind}", f"{values!r} are not all numbers (of at most {FALLBACK_BOUND:g}), words, true or false, or vectors")
    if kind in ("uniform", "normal"):
        if len(values) != 2 or not all(_is_number(v) for v in values):
            raise ConfigError(source, f"{key}.{kind}", f"{values!r} is not two numbers of at most {FALLBACK_BOUND:g}")
        if kind == "uniform" and not values[0] < values[1]:
            raise ConfigError(source, f"{key}.uniform", f"{values[0]} is not below {values[1]}")
        if kind == "normal" and not values[1] > 0:
            raise ConfigError(source, f"{key}.normal", f"sigma {values[1]} is not > 0")
    limits = {name: entry[name] for name in ("low", "high") if name in entry}
    for name, value in limits.items():
        if not _is_number(value):
            raise ConfigError(source, f"{key}.{name}", f"{value!r} is not a number of at most {FALLBACK_BOUND:g}")
    return Distribution(kind, tuple(tuple(v) if isinstance(v, list) else v for v in values), **limits)


def parse_seed(source: str, key: str, entry: Any) -> Distribution:
    """Parse the distribution of the flights' seeds: a grid or a choice.

    Raises:
        ConfigError: another distribution, or values other than integers in the range of seeds.
    """
    found = parse_distribution(source, key, entry)
    if found.kind not in ("grid", "choice") or not all(type(v) is int and 0 <= v <= LARGEST_SEED for v in found.values):
        raise ConfigError(source, key, f"{entry!r} is not a grid or choice of whole numbers in [0, {LARGEST_SEED}]")
    return found


def _kind(value: Any) -> str:
    """Return the kind of a value, which all values of a quantity must share; empty: the value is not permitted."""
    if isinstance(value, list):
        return f"{len(value)} numbers" if value and all(map(_is_number, value)) else ""
    return "number" if _is_number(value) else type(value).__name__ if isinstance(value, (str, bool)) else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= FALLBACK_BOUND
