#!/usr/bin/env python3
"""Run all tests of perch. Sets everything up on first use.

Everything that is not an option of this script goes to pytest.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import subprocess
import sys
import tempfile

from perch_setup import EXTRAS, ROOT, enter

PARTS = (
    ("tests/system/test_restart.py", "tests/system/test_stopping.py", "tests/nodes/"),
    ("tests/system/test_flight_surface.py",), ("tests/system/test_campaign.py",), ("tests/system/test_bad_input.py",),
    ("tests/unit/test_goals_in_a_row.py",), ("tests/unit/test_autopilot_firmware.py",), ("tests/recordings/",),
)
"""What takes longest, so it begins first; files and folders of one part share what is dear to make. Each other file is a part."""
PROCESSES = 1 + min(os.cpu_count() or 1, 5)
"""One more than there are cores: some tests wait for clocks, or for processes that they have started."""
KEPT = ROOT / ".perch" / "pycache"

EXAMPLES = """examples:
  python3 scripts/test.py                        all tests
  python3 scripts/test.py --quick                unit tests that fly, draw and start nothing (`pytest -m quick`)
  python3 scripts/test.py --fast                 without tests/system, which fly whole stacks
  python3 scripts/test.py tests/unit -k camera   some tests
  python3 scripts/test.py -x --lf                any option of pytest
"""


def main() -> int:
    """Run pytest; 0 all passed, 1 some failed, 2 the caller's mistake."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--quick", action="store_true", help="only the unit tests that fly, draw and start nothing")
    parser.add_argument("--fast", action="store_true", help="skip tests/system")
    parser.add_argument("--beside", help=argparse.SUPPRESS)  # the file of `Share`, for the other processes
    arguments, for_pytest = parser.parse_known_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # as tests/conftest.py does, and says why
    os.environ.setdefault("PYTHONPYCACHEPREFIX", str(KEPT))
    enter(*EXTRAS)
    if arguments.quick:
        for_pytest = ["tests/unit", "-m", "quick", *for_pytest]
    return run_tests(arguments.fast, for_pytest, arguments.beside)


def run_tests(fast: bool, for_pytest: list[str], beside: str | None = None) -> int:
    """Run pytest in this process, which keeps a ROS domain to itself meanwhile."""
    from perch_eval.domain import free_domain

    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    # Before the first message class is imported: rclpy does not check fields by default.
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    os.chdir(ROOT)
    if beside is not None:
        return run_share(beside, for_pytest)
    if not fast and not for_pytest and PROCESSES > 2:
        return run_together()
    return run_pytest(["--ignore=tests/system", *for_pytest] if fast else for_pytest)


def run_pytest(arguments: list[str], *plugins: object) -> int:
    """Run pytest in this process; its exit code as `main` has it."""
    import pytest

    code = pytest.main(arguments, plugins)
    return {0: 0, 1: 1}.get(int(code), 2 if code == pytest.ExitCode.USAGE_ERROR else 1)


def run_share(taken: str, arguments: list[str]) -> int:
    """Run what no other process has taken, in this one."""
    return run_pytest(["-o", "console_output_style=classic", *arguments], Share(taken, parts(test_files())))


def run_together() -> int:
    """All tests, in processes beside each other; what the others print comes at the end."""
    with contextlib.ExitStack() as stack:
        taken = stack.enter_context(tempfile.NamedTemporaryFile("w"))
        outputs = [stack.enter_context(tempfile.TemporaryFile("w+", errors="replace")) for _ in range(PROCESSES - 1)]
        others = [subprocess.Popen([sys.executable, __file__, "--beside", taken.name, "-o", f"cache_dir=.pytest_cache/{number}"],
                                   stdout=output, stderr=subprocess.STDOUT) for number, output in enumerate(outputs)]
        print(f"{PROCESSES} processes share the tests; what the others print comes at the end", flush=True)
        try:
            code = run_share(taken.name, [])
            for other in others:
                other.wait()
        except KeyboardInterrupt:  # all have it
            code = 1
        finally:
            for other, output in zip(others, outputs):
                other.terminate()
                other.wait()
                output.seek(0)
                print(output.read(), flush=True)
    return max(code, *(1 if other.returncode else 0 for other in others))


class Share:
    """A plugin of pytest for one of several processes: whenever it is through with a part, it takes the next one, until nothing is left."""

    def __init__(self, taken: str, parts: list[tuple[str, ...]]) -> None:
        """
        Args:
            taken: a file that all processes have, empty at first; it gets a letter for each part that one has taken.
            parts: what there is to take, the same in all processes.
        """
        self._taken, self._parts = taken, parts

    def take(self) -> tuple[str, ...] | None:
        """Files and folders of the next part; None where all are taken."""
        with open(self._taken, "r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            number = len(file.read())
            if number == len(self._parts):
                return None
            file.write("x")
        return self._parts[number]

    def pytest_runtestloop(self, session) -> bool:
        """In place of pytest's own. All processes have collected all tests: a session of pytest collects only once."""
        if session.testsfailed:
            raise session.Interrupted(f"{session.testsfailed} files could not be collected")
        while (part := self.take()) is not None:
            items = [item for item in session.items if any(within(name, item.nodeid.split("::")[0]) for name in part)]
            for item, following in zip(items, [*items[1:], None]):
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if session.shouldstop:
                    raise session.Interrupted(session.shouldstop)
        return True


def within(name: str, file: str) -> bool:
    """Whether a file is that of a part, or lies in its folder."""
    return file == name or name.endswith("/") and file.startswith(name)


def test_files() -> list[str]:
    """All of them, relative to the repository."""
    return sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py"))


def parts(files: list[str]) -> list[tuple[str, ...]]:
    """`PARTS` as far as there are such files, then each of the others, those of whole stacks first."""
    found = [tuple(name for name in part if any(within(name, file) for file in files)) for part in PARTS]
    named = [name for part in PARTS for name in part]
    others = [(file,) for file in files if not any(within(name, file) for name in named)]
    return [part for part in found if part] + sorted(others, key=lambda part: not part[0].startswith("tests/system/"))


if __name__ == "__main__":
    sys.exit(main())
