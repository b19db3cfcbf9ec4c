"""`scripts/test.py`: two processes share all tests, each test is run once, and those that fly come first in one of them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import test as script

FILES = ("tests/nodes/test_a.py", "tests/nodes/test_b.py", "tests/recordings/test_c.py", "tests/recordings/test_d.py", "tests/system/test_e.py",
         "tests/system/test_f.py", "tests/unit/test_g.py", "tests/unit/test_h.py")


@pytest.fixture
def items() -> list[SimpleNamespace]:
    """Two tests of each file."""
    return [SimpleNamespace(path=script.ROOT / file) for file in FILES for _ in range(2)]


def test_files_stay_together_and_those_that_share_what_is_dear_to_make(items):
    parts = script.split(items)
    assert list(parts) == ["tests/system/test_e.py", "tests/system/test_f.py", "tests/nodes/", "tests/recordings/", "tests/unit/test_g.py",
                           "tests/unit/test_h.py"]
    assert [len(part) for part in parts.values()] == [2, 2, 4, 4, 2, 2]


@pytest.mark.parametrize("order", ["fb" * 4, "f" * 8, "b" * 8, "ffbbbfff"])
def test_every_test_is_run_once_whoever_is_faster(items, tmp_path: Path, order):
    (tmp_path / "taken").touch()
    sides = {letter: script.Share(str(tmp_path / "taken"), letter == "f") for letter in "fb"}
    ran: list[SimpleNamespace] = []

    def run(item: SimpleNamespace, nextitem: SimpleNamespace | None) -> None:
        assert nextitem is None or nextitem.path.parent == item.path.parent
        ran.append(item)

    for item in items:
        item.config = SimpleNamespace(hook=SimpleNamespace(pytest_runtest_protocol=run))
    taken = [sides[letter]._take(6) for letter in order]
    assert sorted(number for number in taken if number is not None) == list(range(6)) and taken[6:] == [None, None]
    assert order[0] == "b" or taken[0] == 0
    (tmp_path / "taken").write_text("")
    for letter in order[:2]:
        assert sides[letter].pytest_runtestloop(SimpleNamespace(items=items, testsfailed=0, shouldstop=False, Interrupted=RuntimeError))
    assert len(ran) == len(items) and {id(item) for item in ran} == {id(item) for item in items}
