"""`scripts/test.py`: processes share all tests, each test is run once, what takes longest is begun first."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import test as script

FILES = ["tests/nodes/test_a.py", "tests/nodes/test_b.py", "tests/recordings/test_c.py", "tests/system/test_e.py", "tests/system/test_restart.py",
         "tests/system/test_campaign.py", "tests/unit/test_g.py", "tests/unit/test_h.py"]


def test_files_that_share_what_is_dear_to_make_stay_together_and_the_longest_are_first():
    assert script.parts(FILES) == [
        ("tests/system/test_restart.py", "tests/nodes/"), ("tests/system/test_campaign.py",), ("tests/recordings/",),
        ("tests/system/test_e.py",), ("tests/unit/test_g.py",), ("tests/unit/test_h.py",)]


def test_every_file_is_in_one_part_and_every_part_is_there():
    files, found = script.test_files(), script.parts(script.test_files())
    for file in files:
        assert sum(file == name or name.endswith("/") and file.startswith(name) for part in found for name in part) == 1, file
    assert found[:len(script.PARTS)] == list(script.PARTS)
    assert {Path(file).parent.name for file in files} >= {"unit", "property", "nodes", "recordings", "system", "fuzz"}


@pytest.mark.parametrize("order", ["ab" * 3, "a" * 6, "aabbba"])
def test_every_part_is_taken_once_whoever_is_faster(tmp_path: Path, order):
    (tmp_path / "taken").touch()
    sides = {letter: script.Share(str(tmp_path / "taken"), script.parts(FILES)) for letter in "ab"}
    assert [sides[letter].take() for letter in order] == script.parts(FILES)
    assert [side.take() for side in sides.values()] == [None, None]


PROGRAM = """
import sys, pytest, test
sys.exit(pytest.main(["-p", "no:cacheprovider", "--rootdir=.", "-c", "/dev/null", "-rA", "."], [test.Share("taken", PARTS)]))
"""
GOOD, BAD, BROKEN = "def test_{0}(one): assert one", "def test_{0}(): assert False", "import no_such_module"
SHARED = "import pytest\n@pytest.fixture\ndef one(): return 1\n"
SKIPPED = "import pytest\npytest.skip('{0}', allow_module_level=True)"


@pytest.mark.parametrize("contents, code, words", [
    ((GOOD, GOOD), 0, "2 passed"), ((GOOD, SKIPPED), 0, "1 passed, 1 skipped"), ((BAD, GOOD), 1, "1 failed, 1 passed"),
    ((GOOD, BROKEN, GOOD), 2, "1 error")])
def test_parts_are_run_one_after_the_other_and_whatever_fails_is_told(contents, code, words, tmp_path):
    names = [f"test_{number}.py" for number in range(len(contents))]
    for name, content in zip(names, contents):
        (tmp_path / name).write_text(content.format(name[:-3]))
    (tmp_path / "conftest.py").write_text(SHARED)  # whose fixtures all parts have
    (tmp_path / "taken").touch()
    done = subprocess.run([sys.executable, "-c", PROGRAM.replace("PARTS", repr([(name,) for name in names]))], cwd=tmp_path, capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join([str(script.ROOT / "scripts"), os.environ.get("PYTHONPATH", "")])})
    assert done.returncode == code and words in done.stdout.splitlines()[-1], done.stdout + done.stderr
