"""What a part of the evaluation hands over: rows beside the paper's values, figures, and a verdict on each row."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

HOLDS, FAILS, VACUOUS, SHOWN, MISSING = "holds", "FAILS", "vacuous", "shown", "not available"
BETTER, WORSE = "better", "worse"  # a comparison, not a claim


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        name: what was measured.
        ours: our value, with interval or range.
        paper: the paper's value; empty: it gives none.
        verdict: `holds` or `FAILS` for a claim, `vacuous` for one about nothing that occurred, `better` / `worse` for a
            comparison without a claim, `shown`, `not available` where the part does not exist.
        note: what the claim is, or why it is not available.
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
        key: short name, also that of its files.
        title: heading.
        about: what was done, seeds included.
        rows: the table.
        figures: (file name, caption), in the folder of the results.
        data: figures behind the rows, for the JSON file.
    """

    key: str
    title: str
    about: str
    rows: list[Row] = field(default_factory=list)
    figures: list[tuple[str, str]] = field(default_factory=list)
    data: dict = field(default_factory=dict)

    def claim(self, name: str, ours: str, paper: str, holds: bool | None, note: str) -> None:
        """A row that says whether a claim holds; None: there was nothing that it could be tested on."""
        self.rows.append(Row(name, ours, paper, VACUOUS if holds is None else HOLDS if holds else FAILS, note))

    def compare(self, name: str, ours: str, paper: str, better: bool, note: str = "") -> None:
        """A row that compares without claiming."""
        self.rows.append(Row(name, ours, paper, BETTER if better else WORSE, note))

    def show(self, name: str, ours: str, paper: str = "", note: str = "") -> None:
        """A row without a judgement."""
        self.rows.append(Row(name, ours, paper, SHOWN, note))

    def missing(self, name: str, paper: str, why: str) -> None:
        """A row whose part does not exist."""
        self.rows.append(Row(name, "-", paper, MISSING, why))


@dataclass(frozen=True)
class Effort:
    """How much is spent.

    Attributes:
        full: every part, and more problems in those that only compute.
        jobs: processes for flights.
        out: folder of the results.
        state: folder of what an interrupted evaluation resumes from.
        command: what regenerates the page.
        fresh: forget what an earlier evaluation has done.
        seeds: of the flights of each perch condition.
        seeds_on_lines: of the flights of each powerline scenario.
        layouts: random layouts of the inspection.
    """

    full: bool
    jobs: int
    out: Path
    state: Path
    command: str
    fresh: bool
    seeds: range
    seeds_on_lines: range
    layouts: int
