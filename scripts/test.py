#!/usr/bin/env python3
"""Run all tests of perch. Sets everything up on first use.

Everything that is not an option of this script goes to pytest.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from perch_setup import EXTRAS, ROOT, enter

FLIGHTS = ("tests/system/", "tests/nodes/")
WHOLE = ("tests/nodes/", "tests/recordings/")  # folders whose files share what is dear to make

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
    parser.add_argument("--beside", help=argparse.SUPPRESS)  # the file of `Share`, for the second process
    arguments, for_pytest = parser.parse_known_args()
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
        return run_pytest(for_pytest, Share(beside, from_front=True))
    if not fast and not for_pytest and (os.cpu_count() or 1) > 1:
        return run_in_two()
    return run_pytest(["--ignore=tests/system", *for_pytest] if fast else for_pytest)


def run_pytest(arguments: list[str], *plugins: object) -> int:
    """Run pytest in this process; its exit code as `main` has it."""
    import pytest

    code = pytest.main(arguments, plugins)
    return {0: 0, 1: 1}.get(int(code), 2 if code == pytest.ExitCode.USAGE_ERROR else 1)


def run_in_two() -> int:
    """All tests, on two cores: a second process begins with the flights, and its output comes at the end."""
    with tempfile.TemporaryFile("w+", errors="replace") as output, tempfile.NamedTemporaryFile("w") as taken:
        command = [sys.executable, __file__, "--beside", taken.name, "-o", "cache_dir=.pytest_cache/flights"]
        flights = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        print("two processes share the tests; what the one prints that begins with the flights comes at the end", flush=True)
        try:
            code = run_pytest([], Share(taken.name, from_front=False))
            flights.wait()
        except KeyboardInterrupt:  # both have it
            code = 1
        finally:
            flights.terminate()
            flights.wait()
            output.seek(0)
            print(output.read(), flush=True)
    return max(code, 1 if flights.returncode else 0)


class Share:
    """A plugin of pytest for two processes that have collected the same tests.

    One takes test files from the front, where the flights are, the other from the back, until they meet: flights mostly wait,
    and run beside what computes.
    """

    def __init__(self, taken: str, from_front: bool) -> None:
        """
        Args:
            taken: a file that both have, empty at first; it gets a letter for each part that one has taken.
            from_front: or from the back.
        """
        self._taken, self._letter = taken, "f" if from_front else "b"

    def _take(self, count: int) -> int | None:
        """Number of the next part of so many; None where all are taken."""
        with open(self._taken, "r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            letters = file.read()
            if len(letters) >= count:
                return None
            file.write(self._letter)
        mine = letters.count(self._letter)
        return mine if self._letter == "f" else count - 1 - mine

    def pytest_runtestloop(self, session) -> bool:
        """In place of pytest's own, which runs all that was collected."""
        if session.testsfailed:
            raise session.Interrupted(f"{session.testsfailed} error(s) during collection")
        parts = list(split(session.items).values())
        while (number := self._take(len(parts))) is not None:
            items = parts[number]
            for item, following in zip(items, [*items[1:], None]):
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if session.shouldstop:
                    raise session.Interrupted(session.shouldstop)
        return True


def split(items: list) -> dict[str, list]:
    """File or folder -> its tests, which stay together; flights first."""
    parts: dict[str, list] = {}
    for item in items:
        file = Path(item.path).relative_to(ROOT).as_posix()
        parts.setdefault(next((folder for folder in WHOLE if file.startswith(folder)), file), []).append(item)
    return dict(sorted(parts.items(), key=lambda part: next((k for k, folder in enumerate(FLIGHTS) if part[0].startswith(folder)), len(FLIGHTS))))


if __name__ == "__main__":
    sys.exit(main())
