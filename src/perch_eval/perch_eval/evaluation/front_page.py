"""The table of README.md: the papers' values beside ours, each row from a page of results, with that page's commit.

    python3 -m perch_eval.evaluation.front_page      write it into README.md
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from perch_eval.revision import root

ROWS = (
    ("M, Table II: tracking error (x, y, z together), 90 deg, 1.7 m", "perches", "m_table_2", "90 deg, 1.7 m: tracking, all axes"),
    ("M, Table II: estimation error, 90 deg, 1.7 m", "perches", "m_table_2", "90 deg, 1.7 m: estimation, all axes"),
    ("M, Table III: perches, 90 deg, 1.7 m", "perches", "m_table_3", "90 deg, 1.7 m"),
    ("M, Table III: perches, 90 deg, 3 m", "perches", "m_table_3", "90 deg, 3 m"),
    ("M, Fig. 6: largest body rate, 90 deg, 1.7 m", "perches", "m_fig_6", "largest body rate"),
    ("P, Table I: position error at the cable, 80 deg", "powerline", "p_table_1_flown", "80 deg: position RMSE"),
    ("P, Table I: position error at the cable, upside down", "powerline", "p_table_1_flown", "180 deg: position RMSE"),
    ("perches on the cable, upside down", "powerline", "p_table_1_flown", "180 deg: gripped the cable"),
    ("P, VI-A: collisions in random inspections", "inspection", "p_inspection_layouts", "collisions"),
)
"""Title, folder in docs/results, key of the section, name of the row."""
BEGIN, END = "<!-- results: python3 -m perch_eval.evaluation.front_page -->\n", "<!-- end of results -->"


def table() -> str:
    """The table in Markdown.

    Raises:
        LookupError: a page has no such row.
    """
    lines = ["| | paper | ours | verdict | of commit |", "| --- | --- | --- | --- | --- |"]
    for title, folder, key, name in ROWS:
        path = root() / "docs" / "results" / folder
        sections = json.loads((path / "results.json").read_text())["sections"]
        rows = [row for section in sections if section["key"] == key for row in section["rows"] if row["name"] == name]
        commit = re.search(r"Of commit ([0-9a-f]{7})", (path / "README.md").read_text())
        if not rows or commit is None:
            raise LookupError(f"{path}: no row {name!r} in {key}, or no commit")
        page = Path("docs/results", folder, "README.md").as_posix()
        lines.append(f"| {title} | {rows[0]['paper'] or '-'} | {rows[0]['ours']} | {rows[0]['verdict'].lower()} | [{commit[1]}]({page}) |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the table into README.md."""
    path = root() / "README.md"
    before, _, rest = path.read_text().partition(BEGIN)
    path.write_text(before + BEGIN + table() + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
