"""Pages of results say of which commit they are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from perch_eval.revision import banner

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


@pytest.mark.parametrize("page", sorted(RESULTS.rglob("*.md")), ids=lambda page: str(page.relative_to(RESULTS)))
def test_a_page_says_of_which_code_it_is(page):
    assert re.match(r"# .+\n\n> \*\*(Of commits? [0-9a-f]{7}|Older than the code)", page.read_text())


def test_a_banner_names_all_commits_and_leads_to_what_has_changed():
    assert "Of commit 13d2870+, cde665f.**" in banner("13d2870+, cde665f") and "git diff --stat 13d2870 -- src config" in banner("13d2870+, cde665f")
