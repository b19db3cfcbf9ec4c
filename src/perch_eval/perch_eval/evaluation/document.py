"""Results of an evaluation: sections of rows beside the paper's values, each with a verdict, and figures; their pages and JSON."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from perch_core.json_values import write_json
from perch_eval.revision import banner, code_version

HOLDS, FAILS, VACUOUS, SHOWN, MISSING = "holds", "FAILS", "vacuous", "shown", "not available"
BETTER, WORSE = "better", "worse"  # a comparison, not a claim
_MARK = {HOLDS: "**holds**", FAILS: "**FAILS**", VACUOUS: "*vacuous*", MISSING: "*not available*"}


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


def write(sections: Sequence[Section], effort: Effort, duration: float) -> None:
    """Write `README.md` and `results.json` into the folder of the results; `duration`: of the evaluation [s]."""
    content = {"duration_s": duration, "sections": [
        {"key": s.key, "title": s.title, "about": s.about, "rows": [row.__dict__ for row in s.rows],
         "figures": [name for name, _ in s.figures], "data": s.data} for s in sections]}
    made_by = f"{_made_by(effort)} It took {duration / 60:.0f} min, excluding flights reused from an earlier run."
    _write(effort, "README", _page(sections, made_by), "results", content)


def write_page(effort: Effort, name: str, lines: list[str], content: dict[str, Any]) -> None:
    """Write a page and its data as JSON, both with commit, command and machine; the first of the lines is the title."""
    _write(effort, name, [lines[0], "", _made_by(effort), *lines[1:]], name, content)


def _write(effort: Effort, page: str, lines: list[str], data: str, content: dict[str, Any]) -> None:
    (effort.out / f"{page}.md").write_text("\n".join([lines[0], "", banner([effort.code["commit"]], [effort.code["digest"]]), *lines[1:]]) + "\n")
    write_json(effort.out / f"{data}.json", {**effort.code, "command": effort.command, "machine": machine(), **content})


def _made_by(effort: Effort) -> str:
    return f"Made by `{effort.command}` on {machine()}. This page is generated."


def counts(sections: Sequence[Section]) -> Counter[str]:
    """Return the number of rows by verdict."""
    return Counter(row.verdict for section in sections for row in section.rows)


def table(head: str, rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table. `head`: titles of the columns, separated by bars; bars in cells are escaped."""
    return [f"| {head} |", "| --- " * (head.count("|") + 1) + "|", *(f"| {' | '.join(map(_cell, row))} |" for row in rows)]


def _cell(value: object) -> str:
    return " ".join(str(value).replace("|", "\\|").split())


def machine() -> str:
    """Return a description of this machine."""
    return f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


def _page(sections: Sequence[Section], made_by: str) -> list[str]:
    found = counts(sections)
    failures = [(s.title, row.name, row.ours, row.note) for s in sections for row in s.rows if row.verdict == FAILS]
    lines = ["# Results", "",
             f"{found[HOLDS]} claims hold, {found[FAILS]} fail, {found[VACUOUS]} are vacuous; {found[BETTER]} further values are better than the "
             f"paper's, {found[WORSE]} worse; {found[MISSING]} rows are not available.", "",
             *([*table("part | row | value | claim", failures), ""] if failures else []),
             "*holds*: the claim is true of these flights; *fails*: it is false; *vacuous*: nothing occurred that it is about, or too little; *better*, "
             "*worse*: comparison with the paper, without a claim; *shown*: value without a claim.", "",
             "**M**: Mao et al., *Aggressive Visual Perching with Quadrotors on Inclined Surfaces*. "
             "**P**: Paneque et al., *Perception-Aware Perching on Powerlines with Multirotors*. "
             "The papers flew in a laboratory, this is simulation: a better value here does not mean a better vehicle.", "", made_by]
    for section in sections:
        lines += ["", f"## {section.title}", "", section.about, ""]
        if section.rows:
            lines += table("quantity | ours | paper | verdict | claim or note",
                           ((r.name, r.ours, r.paper, _MARK.get(r.verdict, r.verdict), r.note) for r in section.rows))
        for name, caption in section.figures:
            lines += ["", f"![{caption}]({name})", "", f"*{caption}*"]
    return lines
