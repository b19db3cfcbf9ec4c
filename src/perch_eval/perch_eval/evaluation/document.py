"""Output of the results: a Markdown page and a JSON file."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from perch_core.json_values import write_json
from perch_eval.evaluation.sections import BETTER, FAILS, HOLDS, MISSING, VACUOUS, WORSE, Effort, Section
from perch_eval.revision import banner

_MARK = {HOLDS: "**holds**", FAILS: "**FAILS**", VACUOUS: "*vacuous*", MISSING: "*not available*"}


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
