"""Output of the results: a Markdown page and a JSON file."""

from __future__ import annotations

import os
import platform
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from perch_core.json_values import write_json
from perch_eval.evaluation.sections import BETTER, FAILS, HOLDS, MISSING, VACUOUS, WORSE, Effort, Section
from perch_eval.revision import banner, commit, digest, code_version

_MARK = {HOLDS: "**holds**", FAILS: "**FAILS**", VACUOUS: "*vacuous*", MISSING: "*not available*"}


def write(sections: Sequence[Section], effort: Effort, duration: float) -> None:
    """Write `README.md` and `results.json` into the folder of the results."""
    content = {**code_version(), "command": effort.command, "duration_s": duration, "machine": machine(), "sections": [
        {"key": s.key, "title": s.title, "about": s.about, "rows": [row.__dict__ for row in s.rows],
         "figures": [name for name, _ in s.figures], "data": s.data} for s in sections]}
    write_page(effort, "README", _page(sections, duration), content, "results")


def write_page(effort: Effort, name: str, lines: list[str], content: dict[str, Any], data: str = "") -> None:
    """Write a page and its data as JSON, both with commit, command and machine; `data`: name of the JSON file, if not `name`."""
    made_by = [banner([commit()], [digest()]), "", f"Made by `{effort.command}` on {machine()}. This page is generated."]
    (effort.out / f"{name}.md").write_text("\n".join([lines[0], "", *made_by, *lines[1:]]) + "\n")
    write_json(effort.out / f"{data or name}.json", {**code_version(), "command": effort.command, "machine": machine(), **content})


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


def _page(sections: Sequence[Section], duration: float) -> list[str]:
    found = counts(sections)
    lines = ["# Results", "", f"It took {duration / 60:.0f} min, excluding flights reused from an earlier run.", "",
             f"{found[HOLDS]} claims hold, {found[FAILS]} fail, {found[VACUOUS]} are vacuous (nothing occurred that they are "
             f"about); {found[BETTER]} further values are better than the paper's, {found[WORSE]} worse; "
             f"{found[MISSING]} rows are not available.", "",
             "**M**: Mao et al., *Aggressive Visual Perching with Quadrotors on Inclined Surfaces*. "
             "**P**: Paneque et al., *Perception-Aware Perching on Powerlines with Multirotors*. "
             "The papers flew in a laboratory, this is simulation: a better value here does not mean a better vehicle.", ""]
    lines += [f"* fails: {s.title}: {row.name}: {row.ours} ({row.note})" for s in sections for row in s.rows if row.verdict == FAILS]
    for section in sections:
        lines += ["", f"## {section.title}", "", section.about, ""]
        if section.rows:
            lines += table("| ours | paper | verdict |", ((r.name, r.ours, r.paper, _MARK.get(r.verdict, r.verdict), r.note) for r in section.rows))
        for name, caption in section.figures:
            lines += ["", f"![{caption}]({name})", "", f"*{caption}*"]
    return lines
