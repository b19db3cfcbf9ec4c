"""Common parts of the bench groups: figures, their bars, and time measurement.

    # bench/<group>.py, run by `python3 scripts/bench.py <group>`
    from harness import Figure, figure, measure
    SEEDS = "1"                                                                      # of its random problems, in words
    def figures(quick: bool) -> list[Figure]:
        step = measure(controller_step, repetitions=200 if quick else 5000)          # seconds per call
        return [figure("control step", "us", 1e6 * step, bar=50.0),                  # median <= 50 us holds?
                figure("control step p99", "us", 1e6 * step, bar=100.0, comparison="p99 <="),
                figure("stack start", "s", [1.8])]                                   # no bar: reported only
"""

from __future__ import annotations

import math
import operator
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from perch_core.processes import without_collector
from perch_eval.revision import code_version, command_line

_STATISTICS = {"median": lambda x: float(np.median(x)),
               "p99": lambda x: float(np.percentile(x, 99, method="linear" if np.isfinite(x).all() else "higher")),
               "max": lambda x: float(np.max(x)), "min": lambda x: float(np.min(x))}
_RELATIONS = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}


@dataclass(frozen=True)
class Figure:
    """One measured quantity.

    Attributes:
        name: what was measured, unique within its group.
        unit: unit of median, p99 and bar.
        median: median of the samples.
        p99: 99th percentile of the samples.
        n: number of samples.
        bar: the value to keep; None: reported only.
        comparison: statistic and relation that make the bar, e.g. "median <=", "p99 <=", "min >=", "max ==".
        holds: whether the bar holds; None without a bar.
    """

    name: str
    unit: str
    median: float
    p99: float
    n: int
    bar: float | None = None
    comparison: str = "median <="
    holds: bool | None = None


def figure(name: str, unit: str, samples: Sequence[float] | np.ndarray, bar: float | None = None,
           comparison: str = "median <=") -> Figure:
    """Return a figure from its samples, with the bar evaluated.

    Raises:
        ValueError: no samples, or a comparison that is not `<median|p99|max|min> <<=|>=|==>`.
    """
    values = np.asarray(samples, float).ravel()
    if not values.size:
        raise ValueError(f"{name}: no samples")
    try:
        statistic, relation = comparison.split()
        value, keeps = _STATISTICS[statistic](values), _RELATIONS[relation]
    except (KeyError, ValueError):
        raise ValueError(f"{name}: comparison {comparison!r} is not one of {sorted(_STATISTICS)} with {sorted(_RELATIONS)}") from None
    holds = None if bar is None else bool(math.isfinite(value) and keeps(value, bar))
    return Figure(name, unit, _STATISTICS["median"](values), _STATISTICS["p99"](values), int(values.size), bar, comparison, holds)


def measure(call: Callable[[], object], repetitions: int = 200, warm_up: int = 3) -> np.ndarray:
    """Wall-clock time of each of `repetitions` calls [s], after `warm_up` calls that do not count.

    The garbage collector is off meanwhile, as its pauses belong to no single call.
    """
    for _ in range(warm_up):
        call()
    times = np.empty(repetitions)
    with without_collector():
        for k in range(repetitions):
            begin = time.perf_counter()
            call()
            times[k] = time.perf_counter() - begin
    return times


def provenance() -> dict[str, object]:
    """Return the first entries of a results file: code, command and machine; called before measuring, the load is that of other programs."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0] if names else model
    machine = {"cpu": model, "cores": os.cpu_count(), "load_1min": round(os.getloadavg()[0], 2),
               "python": platform.python_version(), "numpy": np.__version__, "system": platform.platform()}
    return {**code_version(), "command": command_line(), "machine": machine}


def as_json(group_figures: dict[str, list[Figure]]) -> list[dict[str, object]]:
    """Return the figures of all groups in their common JSON form."""
    return [{"group": group, **asdict(item)} for group, items in group_figures.items() for item in items]


def table(items: list[Figure]) -> str:
    """Return the figures of a group as a text table."""
    rows = [("figure", "median", "p99", "n", "unit", "bar", "")]
    for item in items:
        bar = "" if item.bar is None else f"{item.comparison} {item.bar:g}"
        rows.append((item.name, f"{item.median:.4g}", f"{item.p99:.4g}", str(item.n), item.unit, bar,
                     {None: "", True: "holds", False: "DOES NOT HOLD"}[item.holds]))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) if k in (0, 4, 5) else cell.rjust(w) for k, (cell, w) in enumerate(zip(row, widths))).rstrip()
             for row in rows]
    return "\n".join(lines)
