"""Results of a campaign in one file that survives a crash of its writer, and selection of the worst flights."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_eval.campaign.causes import ERROR, SUCCESS
from perch_eval.rows import Rows, rows_of


@dataclass(frozen=True)
class RunResult:
    """Result of one run."""

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
    """Results file: a header row with the campaign's name and digest, then a row per run. One process writes; others may read."""

    def __init__(self, path: Path, name: str, digest: str, resume: bool) -> None:
        """
        Args:
            path: path of the file.
            name, digest: name and digest of the campaign.
            resume: continue an earlier campaign from its results.

        Raises:
            ResultsError: the file holds another campaign's results, holds results while `resume` is False, is damaged, or is missing
                while flights of an earlier campaign are beside it.
        """
        header, found = read_results(path)
        kept = path.parent / flight_folder(0).parent
        if not found and kept.exists():
            raise ResultsError(f"{kept} holds flights of an earlier campaign whose results are gone: move it away, or choose another --out")
        if header and header.get("digest") != digest:
            raise ResultsError(f"{path} holds results of campaign {header.get('name')!r} with other settings or code: "
                               "choose another --out, or the original settings and code")
        if found and not resume:
            raise ResultsError(f"{path} already holds {len(found)} results: --resume continues with them, another --out starts a new campaign")
        self._results = {result.number: result for result in found}
        try:
            self._rows = Rows(path, [{"name": name, "digest": digest}, *map(asdict, found)])
        except OSError as error:
            raise _unreadable(path, error) from None

    def add(self, result: RunResult) -> None:
        """Write the row of a run, unless the file already holds it; a row with the cause `error` is replaced."""
        if result.number in self.finished:
            return
        self._rows.add(asdict(result))
        self._results[result.number] = result

    @property
    def finished(self) -> set[int]:
        """Numbers of the runs that were carried out."""
        return {number for number, result in self._results.items() if result.cause != ERROR}

    def all(self) -> list[RunResult]:
        """Return all results, sorted by number."""
        return [self._results[number] for number in sorted(self._results)]

    def close(self) -> None:
        """Close the file."""
        self._rows.close()


def read_results(path: Path) -> tuple[dict[str, Any], list[RunResult]]:
    """Return a file's header row and its results sorted by number; both are empty where there is no file.

    The file may be read while a campaign is writing it. Of several rows of a run the last one counts.

    Raises:
        ResultsError: the file cannot be read.
    """
    try:
        header, *rows = [*rows_of(path)] or [{}]
        found = {result.number: result for result in (_result(**row) for row in rows)}
        return dict(header), [found[number] for number in sorted(found)]
    except (OSError, ValueError, TypeError, RecursionError) as error:  # of the file, of JSON in it, of its rows, of JSON's depth
        raise _unreadable(path, error) from None


def _result(number: int, seed: int, metrics: dict[str, Any], values: dict[str, Any], wall_time: float, **words: str) -> RunResult:
    figures = {name: None if value is None else float(value) for name, value in dict(metrics).items()}
    return RunResult(int(number), int(seed), values=dict(values), metrics=figures, wall_time=float(wall_time), **words)


def _unreadable(path: Path, error: Exception) -> ResultsError:
    return ResultsError(f"{path} cannot be read as results ({error}): choose another --out")


def flight_folder(number: int) -> Path:
    """Return the folder of a kept flight, relative to the campaign's folder."""
    return Path("flights", f"run_{number:05d}")


def severity(result: RunResult) -> float:
    """Return a score of a flight's contact and tracking errors; larger is worse. Without a contact only tracking RMSE counts."""
    m = result.metrics

    def metric(name: str) -> float:
        return m.get(name) or 0.0

    return (metric("contact_tilt_error_deg") / 15.0 + metric("contact_tangential_speed_m_s") / 0.6 + metric("contact_offset_m") / 0.3
            + sum(metric(f"tracking_rmse_m_{axis}") for axis in "xyz") / 0.3)


def worst(found: list[RunResult], count: int) -> list[RunResult]:
    """Return the worst flights: one of each cause in turn, frequent causes first, most severe first within a cause.

    Successful flights follow, most severe first. Runs that could not be carried out are left out.
    """
    groups: dict[str, list[RunResult]] = defaultdict(list)
    for result in found:
        if result.cause not in (SUCCESS, ERROR):
            groups[result.cause].append(result)
    order = sorted(groups.values(), key=lambda group: (-len(group), group[0].cause))
    for group in order:
        group.sort(key=lambda r: (-severity(r), r.number))
    turns = [group[k] for k in range(max(map(len, order), default=0)) for group in order if k < len(group)]
    good = sorted((r for r in found if r.cause == SUCCESS), key=lambda r: (-severity(r), r.number))
    return (turns + good)[:count]
