"""`scripts/test.py`: processes share all tests, each test is run once, what takes longest is begun first."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
import test as script

FILES = ["tests/nodes/test_a.py", "tests/nodes/test_b.py", "tests/recordings/test_c.py", "tests/system/test_e.py", "tests/system/test_restart.py",
         "tests/system/test_campaign.py", "tests/unit/test_g.py", "tests/unit/test_h.py"]


def test_files_that_share_what_is_dear_to_make_stay_together_and_the_longest_are_first():
    assert script.parts(FILES) == [
        ("tests/system/test_restart.py",), ("tests/recordings/",), ("tests/nodes/",), ("tests/system/test_campaign.py",),
        ("tests/system/test_e.py",), ("tests/unit/test_g.py",), ("tests/unit/test_h.py",)]


def test_every_file_is_in_one_part_and_every_part_is_there():
    files, found = script.test_files(), script.parts(script.test_files())
    for file in files:
        assert sum(file == name or name.endswith("/") and file.startswith(name) for part in found for name in part) == 1, file
    assert found[:len(script.PARTS)] == list(script.PARTS)
    assert {Path(file).parent.name for file in files} >= {"unit", "property", "nodes", "recordings", "system", "fuzz"}


def test_every_part_is_taken_once():
    workers = script.WorkerPlugin(script.parts(FILES), 2)
    assert [workers.next_part() for _ in script.parts(FILES)] == script.parts(FILES) and workers.next_part() is None


@pytest.mark.parametrize("words, chosen", [([], ["-m", "quick", "tests/unit"]), (["tests/unit/test_lines.py"], ["-m", "quick", "tests/unit/test_lines.py"])])
def test_the_quick_ones_of_a_file_are_those_of_this_file_only(monkeypatch, words, chosen):
    monkeypatch.setattr(script, "PROCESSES", 1)
    monkeypatch.setattr(script, "run_pytest", lambda arguments: arguments)
    monkeypatch.setenv("ROS_DOMAIN_ID", "1")
    monkeypatch.chdir(script.ROOT)
    assert script.run_tests(True, False, words) == chosen


@pytest.mark.parametrize("quick, fast, chosen", [(False, False, []), (True, False, ["-m", "quick", "tests/unit"]), (False, True, ["--ignore=tests/system"])])
def test_processes_share_what_is_chosen_by_an_option(monkeypatch, quick, fast, chosen):
    monkeypatch.setattr(script, "PROCESSES", 3)
    monkeypatch.setattr(script, "run_pytest", lambda arguments, *plugins: (arguments, type(plugins[0])))
    monkeypatch.setattr(script.WorkerPlugin, "end", lambda self, code: sys.exit(code))
    monkeypatch.setenv("ROS_DOMAIN_ID", "1")
    monkeypatch.chdir(script.ROOT)
    with pytest.raises(SystemExit) as end:
        script.run_tests(quick, fast, [])
    assert end.value.code == ([*chosen, "-o", "console_output_style=classic"], script.WorkerPlugin)


PROGRAM = """
import os, sys, pytest, test
sys.first = os.getpid()
workers = test.WorkerPlugin(PARTS, 2)
workers.end(test.run_pytest(["--rootdir=.", "-c", "/dev/null", "-rA", "."], workers))
"""
GOOD, BAD, BROKEN = "def test_{0}(one): assert one", "def test_{0}(): assert False", "import no_such_module"
SHARED = "import pytest\n@pytest.fixture\ndef one(): return 1\n"
CRASHED = "import os, sys\ndef test_{0}(): os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT) if os.getpid() == sys.first else os.kill(os.getpid(), 11)"
STOPPED = "def test_{0}(): raise KeyboardInterrupt"
SKIPPED = "import pytest\npytest.skip('{0}', allow_module_level=True)"


@pytest.mark.parametrize("contents, code, words", [
    ((*(GOOD,) * 9, SKIPPED), 0, {"passed": 9, "skipped": 2}), ((BAD, GOOD), 1, {"failed": 1, "passed": 1}),
    ((GOOD, BROKEN, GOOD), 1, {"error": 1}), ((CRASHED, CRASHED), 1, {"passed": 1}), ((STOPPED, STOPPED), 130, {})])
def test_two_processes_run_each_part_once_and_whatever_fails_is_told(contents, code, words, tmp_path):
    """Both have collected what is skipped as a file."""
    names = [f"test_{number}.py" for number in range(len(contents))]
    for name, content in zip(names, contents):
        (tmp_path / name).write_text(content.format(name[:-3]))
    (tmp_path / "conftest.py").write_text(SHARED)  # whose fixtures all parts have
    done = subprocess.run([sys.executable, "-c", PROGRAM.replace("PARTS", repr([(name,) for name in names]))], cwd=tmp_path, capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join([str(script.ROOT / "scripts"), os.environ.get("PYTHONPATH", "")])})
    told = Counter()
    for line in re.findall(r"^=+ (.*) in [\d.]+s =+$", done.stdout, re.MULTILINE):
        told.update({word: int(count) for count, word in re.findall(r"(\d+) (passed|failed|skipped|error)", line)})
    assert (done.returncode, told) == (code, words), done.stdout + done.stderr
    assert ("ended with signal 11" in done.stdout) == (CRASHED in contents)
