"""Files: what was found once stays mended, and a hundred new mutations; the long form is `scripts/fuzz.py files`."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from fuzzing.files import Nonsense, judge, kinds, mutated

CASES = sorted((Path(__file__).parent / "cases" / "files").iterdir())
FILES = [(kind, file) for kind, files in kinds().items() for file in files]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_was_found_stays_mended(case):
    judge(case.name.partition("-")[0], case.read_bytes())


@pytest.mark.parametrize("kind, file", FILES, ids=lambda value: getattr(value, "name", value))
def test_the_repositorys_own_files_are_accepted(kind, file):
    assert judge(kind, file.read_bytes()) == "accepted"


@settings(max_examples=120)
@given(st.sampled_from(FILES), st.randoms(use_true_random=False))
def test_a_mutated_file_loads_to_sense_or_is_refused_in_one_line(file, rng):
    judge(file[0], mutated(file[1].read_bytes(), rng))


def test_the_oracle_knows_nonsense(monkeypatch):
    kind, file = next(one for one in FILES if one[1].name == "snapdragon.yaml" and one[0] == "vehicle")
    monkeypatch.setattr("perch_core.config.check", lambda *_: None)
    with pytest.raises(Nonsense, match="outside its range"):
        judge(kind, file.read_bytes().replace(b"drag: [0.1", b"drag: [1e30").replace(b"drag: [0.03", b"drag: [1e30"))
