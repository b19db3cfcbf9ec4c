"""Result of a part of the evaluation: rows beside the paper's values, a verdict on each row, and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from perch_eval.revision import code_version

HOLDS, FAILS, VACUOUS, SHOWN, MISSING = "holds", "FAILS", "vacuous", "shown", "not available"
BETTER, WORSE = "better", "worse"  # a comparison, not a claim


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        name: name of the measured quantity.
        ours: our value, with interval or range.
        paper: the paper's value; empty: the paper gives none.
        verdict: `holds` or `FAILS` for a claim, `vacuous` for a claim about cases of which too few occurred, `better` or `worse` for a
            comparison without a claim, `shown`, or `not available` if there is no value.
        note: the claim, a remark, or the reason why there is no value.
    """

    name: str
    ours: str
    paper: str
    verdict: str
    note: str = ""


@dataclass
class Section:
    """One table or figure of a paper.

    Attributes:
        key: short name, in the JSON file.
        title: heading.
        about: description of the experiment, including the seeds.
        rows: rows of the table.
        figures: (file name, caption) of the figures, in the folder of the results.
        data: values behind the rows, for the JSON file.
    """

    key: str
    title: str
    about: str
    rows: list[Row] = field(default_factory=list)
    figures: list[tuple[str, str]] = field(default_factory=list)
    data: dict = field(default_factory=dict)

    def claim(self, name: str, ours: str, paper: str, holds: bool | None, note: str) -> None:
        """Add a row with the verdict on a claim; None: there was no case to test it on, or too few that do not contradict it."""
        self.rows.append(Row(name, ours, paper, VACUOUS if holds is None else HOLDS if holds else FAILS, note))

    def compare(self, name: str, ours: str, paper: str, better: bool, note: str = "") -> None:
        """Add a row that compares our value with the paper's without a claim."""
        self.rows.append(Row(name, ours, paper, BETTER if better else WORSE, note))

    def show(self, name: str, ours: str, paper: str = "", note: str = "") -> None:
        """Add a row without a verdict."""
        self.rows.append(Row(name, ours, paper, SHOWN, note))

    def missing(self, name: str, paper: str, why: str) -> None:
        """Add a row without a value."""
        self.rows.append(Row(name, "-", paper, MISSING, why))


@dataclass(frozen=True)
class Effort:
    """Extent of an evaluation.

    Attributes:
        full: more planning problems and seeds of the comparison; by default also every part.
        jobs: number of processes for flights.
        out: folder of the results.
        state: folder of the finished flights from which an interrupted evaluation resumes.
        command: command that regenerates the page.
        seeds: seeds of the flights of each perch condition.
        seeds_on_lines: seeds of the flights of each powerline scenario.
        layouts: number of random layouts of the inspection.
        code: commit and digest of the code at the start, which are those of flights and pages.
    """

    full: bool
    jobs: int
    out: Path
    state: Path
    command: str
    seeds: range
    seeds_on_lines: range
    layouts: int
    code: Mapping[str, str] = field(default_factory=code_version)
