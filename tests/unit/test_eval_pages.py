"""The pages in docs/results are those of the rows beside them."""
import json
import re
from pathlib import Path

import pytest

from perch_eval import soak
from perch_eval.campaign.results import RunResult
from perch_eval.evaluation import contact, control, document, ways_out
from perch_eval.evaluation.document import Effort, Row, Section
from perch_eval.graph_faults import campaign as graph_faults

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


def body(page: str) -> list[str]:
    """The lines of a page but those on commit, command and machine."""
    return [line for line in page.splitlines() if not line.startswith(("> **Of ", "Made by ")) and " flights of `surface_90` at " not in line]


def stored(name: str) -> dict:
    return json.loads((RESULTS / f"{name}.json").read_text())


@pytest.mark.parametrize("key, name, section", [
    ("c_faults", "faults_in_flight", control.fault_sections), ("c_comparison", "comparison", control.comparison_sections),
    ("c_way_out", "way_out", ways_out.sections), ("c_contact", "contact", contact.contact_sections)])
def test_the_page_of_a_part_is_that_of_its_flights(key, name, section, tmp_path, monkeypatch):
    content = stored(name)
    rows = {"faults": content.get("flights"), "comparison": content.get("flights"), "aborted": content.get("flights"), "ways_out": content.get("plans")}
    papers: dict[str, list[RunResult]] = {}
    for row in content.get("papers", ()):
        papers.setdefault(row["values"]["scenario"], []).append(RunResult(**row))
    for module in (control, ways_out):
        monkeypatch.setattr(module, "cached_figures", lambda effort, name, *_: rows[name])
    monkeypatch.setattr(contact, "perches", lambda effort: papers)
    monkeypatch.setattr(contact, "cached_runs", lambda effort, name, *_: [RunResult(**row) for row in content[name]])
    effort = Effort(True, 1, tmp_path, tmp_path, content["command"], range(1, 101), range(1, 21), 20, {"commit": "1234567", "digest": ""})
    (made,) = section(effort)
    assert body((tmp_path / f"{name}.md").read_text()) == body((RESULTS / f"{name}.md").read_text())
    rows_of_results = next(one["rows"] for one in stored("results")["sections"] if one["key"] == key)
    assert [row.__dict__ for row in made.rows] == rows_of_results
    written = json.loads((tmp_path / f"{name}.json").read_text())
    assert {part: rows for part, rows in written.items() if isinstance(rows, list)} == {
        part: rows for part, rows in content.items() if isinstance(rows, list)}


def test_the_page_of_results_is_that_of_its_rows():
    page = (RESULTS / "README.md").read_text()
    captions = {name: caption for caption, name in re.findall(r"!\[([^]]*)\]\(([^)]*)\)", page)}
    sections = [Section(one["key"], one["title"], one["about"], [Row(**row) for row in one["rows"]], [(name, captions[name]) for name in one["figures"]])
                for one in stored("results")["sections"]]
    assert body("\n".join(document._page(sections, "Made by `it`"))) == body(re.sub(r"> \*\*Of .*\n\n", "", page))


def test_the_pages_of_soak_and_of_faults_on_the_graph_are_those_of_their_rows():
    assert body(soak.page(RESULTS / "soak")) == body((RESULTS / "soak" / "README.md").read_text())
    rows = graph_faults.load(RESULTS / "faults" / graph_faults.ROWS)
    page = graph_faults.page([rows[case] for case in graph_faults.cases() if case in rows])
    assert body(page) == body((RESULTS / "faults" / "README.md").read_text())
