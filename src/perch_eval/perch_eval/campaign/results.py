"""Results of a campaign in one SQLite file: a row is there or it is not, whatever happens to the process. And which are worth a look."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_eval.campaign.causes import SUCCESS

_SCHEMA = """
CREATE TABLE IF NOT EXISTS campaign (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
    run INTEGER PRIMARY KEY,      -- number in the campaign
    seed INTEGER NOT NULL,
    cause TEXT NOT NULL,          -- 'perched', or why not
    outcome TEXT NOT NULL,        -- the mission's result
    message TEXT NOT NULL,
    vary TEXT NOT NULL,           -- JSON: varied name -> value
    metrics TEXT NOT NULL,        -- JSON: name -> number or null
    wall_time REAL NOT NULL,      -- [s]
    finished TEXT NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now'))
);
"""


@dataclass(frozen=True)
class RunResult:
    """What one flight gave."""

    number: int
    seed: int
    cause: str
    outcome: str
    message: str
    values: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, float | None] = field(default_factory=dict)
    wall_time: float = 0.0


class ResultsError(PerchError):
    """The results file does not belong to this campaign, or may not be overwritten."""


class Results:
    """The file. One process writes; others may read at any time."""

    def __init__(self, path: Path, name: str, digest: str, resume: bool) -> None:
        """
        Args:
            path: of the file.
            name, digest: of the campaign.
            resume: go on where an earlier campaign ended.

        Raises:
            ResultsError: it holds another campaign's results, or results and `resume` is not asked for, or it is damaged.
        """
        try:
            self._db = sqlite3.connect(path)
        except sqlite3.Error as error:
            raise _unreadable(path, error) from None
        try:
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_SCHEMA)
            known = dict(self._db.execute("SELECT key, value FROM campaign"))
            finished = len(_read(self._db))
        except _DAMAGE as error:
            self._db.close()
            raise _unreadable(path, error) from None
        if known and known.get("digest") != digest:
            self._db.close()
            raise ResultsError(f"{path} holds results of campaign {known.get('name')!r} with other settings: "
                               "choose another --out, or the settings of then")
        if finished and not resume:
            self._db.close()
            raise ResultsError(f"{path} already holds {finished} results: --resume goes on with them, another --out starts anew")
        with self._db:
            self._db.executemany("INSERT OR REPLACE INTO campaign VALUES (?, ?)", [("name", name), ("digest", digest)])

    def add(self, result: RunResult) -> None:
        """Write one row; a run that is there already is left as it is."""
        with self._db:
            self._db.execute(
                "INSERT OR IGNORE INTO runs (run, seed, cause, outcome, message, vary, metrics, wall_time) "
                "VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (result.number, result.seed, result.cause, result.outcome, result.message, json.dumps(result.values),
                 json.dumps(result.metrics), result.wall_time))

    def finished(self) -> set[int]:
        """Numbers of the runs that have a result."""
        return {row[0] for row in self._db.execute("SELECT run FROM runs")}

    def all(self) -> list[RunResult]:
        """Every result, by number."""
        return _read(self._db)

    def close(self) -> None:
        """Fold the write-ahead log into the file and close it."""
        self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._db.close()


def read_results(path: Path) -> list[RunResult]:
    """Every result in a file, by number, also while a campaign is writing it.

    Raises:
        ResultsError: it cannot be read.
    """
    try:
        with contextlib.closing(sqlite3.connect(f"{Path(path).absolute().as_uri()}?mode=ro", uri=True)) as db:
            return _read(db)
    except _DAMAGE as error:
        raise _unreadable(path, error) from None


_DAMAGE = (sqlite3.Error, ValueError, TypeError, RecursionError)  # of the file, of JSON in it, of its columns, of JSON's depth


def _unreadable(path: Path, error: Exception) -> ResultsError:
    return ResultsError(f"{path} cannot be read as results ({error}): choose another --out")


def _read(db: sqlite3.Connection) -> list[RunResult]:
    rows = db.execute("SELECT run, seed, cause, outcome, message, vary, metrics, wall_time FROM runs ORDER BY run")
    return [RunResult(int(n), int(seed), str(cause), str(outcome), str(message), dict(json.loads(vary)), _figures(json.loads(metrics)), float(wall))
            for n, seed, cause, outcome, message, vary, metrics, wall in rows]


def _figures(metrics: dict[str, Any]) -> dict[str, float | None]:
    return {name: None if value is None else float(value) for name, value in dict(metrics).items()}


def severity(result: RunResult) -> float:
    """How far from a good contact a flight was; larger is worse. Flights without a contact count by their tracking."""
    m = result.metrics

    def of(name: str) -> float:
        return m.get(name) or 0.0

    return (of("contact_tilt_error_deg") / 15.0 + of("contact_tangential_speed_m_s") / 0.6 + of("contact_offset_m") / 0.3
            + sum(of(f"tracking_rmse_m_{axis}") for axis in "xyz") / 0.3)


def worst(found: list[RunResult], count: int) -> list[RunResult]:
    """The worst flights: in turn one of each cause, the frequent causes first, the severest first within a cause.

    Runs that could not be carried out have nothing to show and are left out.
    """
    groups: dict[str, list[RunResult]] = defaultdict(list)
    for result in found:
        if result.cause not in (SUCCESS, "error"):
            groups[result.cause].append(result)
    order = sorted(groups.values(), key=lambda group: (-len(group), group[0].cause))
    for group in order:
        group.sort(key=lambda r: (-severity(r), r.number))
    turns = [group[k] for k in range(max(map(len, order), default=0)) for group in order if k < len(group)]
    good = sorted((r for r in found if r.cause == SUCCESS), key=lambda r: (-severity(r), r.number))
    return (turns + good)[:count]
