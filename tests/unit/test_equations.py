"""Each equation of both papers has one definition, which flies, and the index leads to it."""

from pathlib import Path

import pytest

from perch_eval.equations import TITLES, definitions, equations_of, page, problems

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("text, expected", [
    ("[M:eq15]", [("M", "eq15")]),
    ("[P:eq3-5]", [("P", "eq3"), ("P", "eq4"), ("P", "eq5")]),
    ("[M:eq2,12-13] and [uses M:alg1]", [("M", "eq2"), ("M", "eq12"), ("M", "eq13"), ("M", "alg1")]),
    ("[P:eq14h]", [("P", "eq14")]),
    ("[defines M:eq3, M:eq17]", [("M", "eq3"), ("M", "eq17")]),
    ("[defines M:eq1, P:eq1]", [("M", "eq1"), ("P", "eq1")]),
    ("[M:IV-B]", []),
])
def test_tags_are_read(text, expected):
    assert equations_of(text) == expected


@pytest.mark.slow
def test_each_equation_has_one_definition_and_it_flies():
    assert problems(ROOT) == []


@pytest.mark.slow
def test_the_page_is_that_of_the_code():
    assert (ROOT / "docs" / "equations.md").read_bytes() == page(ROOT).encode(), "run python3 scripts/equations.py"


def tree(root: Path, law: str, flown: str = "from perch_a.law import law\nNODE = law\n") -> Path:
    """A workspace of one package: a node that flies a law."""
    package = root / "src" / "perch_a" / "perch_a"
    package.mkdir(parents=True)
    (package / "fly_node.py").write_text(flown)
    (package / "law.py").write_text(law)
    return root


def wrong(root: Path, number: int = 2) -> list[str]:
    return [line for line in problems(root) if line.startswith(f"M:eq{number} ")]


LAW = 'def gain():\n    """[defines M:eq2]"""\n\n\ndef law():\n    """Flies."""\n    return gain()\n'


def test_a_definition_is_found_through_what_calls_it(tmp_path):
    root = tree(tmp_path, LAW)
    assert wrong(root) == [] and "none" in wrong(root, 3)[0]
    place, = definitions(root)["M", "eq2"]
    assert (place.file, place.name) == ("src/perch_a/perch_a/law.py", "gain") and f"[`perch_a/law.py: gain`](../{place.file})" in page(root)


def test_a_row_names_the_tests_of_its_equation_not_those_that_mention_it(tmp_path):
    root = tree(tmp_path, LAW)
    (root / "tests").mkdir()
    (root / "tests" / "test_law.py").write_text('"""[tests M:eq2-3]"""\n')
    (root / "tests" / "test_flight.py").write_text('"""[M:eq2] flies. [uses M:eq3]"""\n')
    rows = [line for line in page(root).splitlines() if line.startswith(("| M (2)", "| M (3)"))]
    assert len(rows) == 2 and all("test_law.py" in row and "test_flight.py" not in row for row in rows)


@pytest.mark.parametrize("flown", ["from perch_a import law\nNODE = law.law()\n", "import perch_a.law as l\nNODE = l.law\n",
                                   'NODE = "perch_a.law:law"\n'])
def test_modules_and_registries_are_followed(tmp_path, flown):
    assert wrong(tree(tmp_path, LAW, flown)) == []


@pytest.mark.parametrize("law, word", [
    (LAW + '\n\ndef other():\n    """[defines M:eq2]"""\n', "2 definitions"),
    (LAW.replace("defines", "uses"), "0 definitions"),
    (LAW.replace("return gain()", "return 0"), "no program reaches"),
    (LAW.replace("M:eq2]", "M:eq2, M:eq18]"), "although"),
    (LAW.replace("M:eq2]", "M:eq2, M:eq20]"), "no equation"),
])
def test_two_definitions_none_and_one_that_does_not_fly_are_refused(tmp_path, law, word):
    faults = set(problems(tree(tmp_path / "wrong", law))) - set(problems(tree(tmp_path / "right", LAW)))  # most equations have no definition in both
    assert len(faults) == 1 and word in faults.pop()


@pytest.mark.slow
def test_the_index_names_every_equation():
    text = page(ROOT)
    assert all(title in text for titles in TITLES.values() for title in titles.values())
