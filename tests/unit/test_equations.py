"""Every equation of both papers is somewhere in the code, and the index is up to date."""

from pathlib import Path

import pytest

from perch_eval.equations import TITLES, collect, defined_twice, equations_of, missing, page

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("text, expected", [
    ("[M:eq15]", [("M", "eq15")]),
    ("[P:eq3-5]", [("P", "eq3"), ("P", "eq4"), ("P", "eq5")]),
    ("[M:eq2,12-13] and [M:alg1]", [("M", "eq2"), ("M", "eq12"), ("M", "eq13"), ("M", "alg1")]),
    ("[P:eq14h]", [("P", "eq14")]),
    ("[defines M:eq3, M:eq17]", [("M", "eq3"), ("M", "eq17")]),
    ("[M:IV-B]", []),
])
def test_tags_are_read(text, expected):
    assert equations_of(text) == expected


def test_no_equation_is_missing():
    assert [f"{paper}:{eq} {TITLES[paper][eq]}" for paper, eq in missing(ROOT)] == []


def test_what_the_planner_has_of_paper_m_is_defined_once():
    assert defined_twice(ROOT) == []
    code = collect(ROOT, ("src",))
    for eq in ("eq3", "eq4", "eq5", "eq6", "eq7", "eq8", "eq11", "eq14", "eq15", "eq16", "eq17", "eq18", "eq19", "alg1"):
        assert [place.defines for place in code["M", eq]].count(True) == 1, eq


def test_the_index_names_every_equation():
    text = page(ROOT)
    for paper, titles in TITLES.items():
        for title in titles.values():
            assert title in text
    assert (ROOT / "docs" / "equations.md").exists()
