"""Table of README.md: the papers' values beside ours, from docs/results, with the commit.

    python3 -m perch_eval.evaluation.front_page      write it into README.md
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from perch_eval.evaluation import document
from perch_eval.evaluation.powerline import POSITION
from perch_eval.evaluation.document import MISSING
from perch_eval.revision import root

ROWS = (
    ("M, Table II: tracking error (x, y, z together), 90 deg, 1.7 m", "m_table_2", "90 deg, 1.7 m: tracking, all axes"),
    ("M, Table II: estimation error, 90 deg, 1.7 m", "m_table_2", "90 deg, 1.7 m: estimation, all axes"),
    ("M, Table III: perches, 90 deg, 1.7 m", "m_table_3", "90 deg, 1.7 m"),
    ("M, Table III: perches, 90 deg, 3 m", "m_table_3", "90 deg, 3 m"),
    ("M, Fig. 6: largest body rate, 90 deg, 1.7 m", "m_fig_6", "largest body rate, `surface_90`"),
    ("M, Fig. 6: largest body rate, 90 deg, 1.7 m, setting `surface_90_aggressive`", "m_fig_6", "largest body rate, `surface_90_aggressive`"),
    ("P, Table I: position RMSE at the cable, true against planned place, 80 deg", "p_table_1_flown", f"80 deg: {POSITION}"),
    ("P, Table I: position RMSE at the cable, true against planned place, upside down", "p_table_1_flown", f"180 deg: {POSITION}"),
    ("perches on the cable, upside down", "p_table_1_flown", "180 deg: gripped the cable"),
    ("P, VI-A: collisions in random inspections", "p_inspection_layouts", "collisions"),
)
"""(Title, key of the section, name of the row) of each line."""
BEGIN, END = "<!-- results: python3 -m perch_eval.evaluation.front_page -->\n", "<!-- end of results -->"


def table() -> str:
    """Return the table in Markdown; rows that the page of results does not contain are marked as missing.

    Raises:
        LookupError: the page of results contains no commit.
    """
    page = Path("docs/results/README.md")
    rows = {(section["key"], row["name"]): row
            for section in json.loads((root() / page).with_name("results.json").read_text())["sections"] for row in section["rows"]}
    commit = re.search(r"\*\*Of (commits? [^*\n]+)\*\*", (root() / page).read_text())
    if commit is None:
        raise LookupError(f"{page}: no commit")
    missing = {"paper": "", "ours": "not evaluated", "verdict": MISSING}
    found = ((title, rows.get((key, name), missing)) for title, key, name in ROWS)
    lines = document.table(f"condition ([{commit[1]}]({page})) | paper | ours | verdict", (
        (title, row["paper"] or "-", row["ours"], row["verdict"].lower()) for title, row in found))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the table into README.md."""
    path = root() / "README.md"
    before, _, rest = path.read_text().partition(BEGIN)
    path.write_text(before + BEGIN + table() + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
