#!/usr/bin/env python3
"""Run all tests of perch. Sets everything up on first use.

Everything that is not an option of this script goes to pytest.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile

from perch_setup import ROOT, enter

FLIGHTS = ("tests/nodes", "tests/system")  # about half of the time, much of it spent waiting for processes

EXAMPLES = """examples:
  python3 scripts/test.py                        all tests
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
    parser.add_argument("--fast", action="store_true", help="skip tests/system")
    arguments, for_pytest = parser.parse_known_args()
    enter()
    return run(arguments.fast, for_pytest)


def run(fast: bool, for_pytest: list[str]) -> int:
    """Run pytest in this process, which keeps a ROS domain to itself meanwhile."""
    from perch_eval.domain import free_domain

    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    # Before the first message class is imported: rclpy does not check fields by default.
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    os.chdir(ROOT)
    if not fast and not for_pytest and (os.cpu_count() or 1) > 1:
        return run_beside_flights()
    return run_pytest(["--ignore=tests/system", *for_pytest] if fast else for_pytest)


def run_pytest(arguments: list[str]) -> int:
    """Run pytest in this process; its exit code as `main` has it."""
    import pytest

    code = pytest.main(arguments)
    return {0: 0, 1: 1}.get(int(code), 2 if code == pytest.ExitCode.USAGE_ERROR else 1)


def run_beside_flights() -> int:
    """All tests, on two cores: those of nodes and stacks in a process of their own, whose output comes at the end."""
    with tempfile.TemporaryFile("w+", errors="replace") as output:
        command = [sys.executable, __file__, *FLIGHTS, "-o", "cache_dir=.pytest_cache/flights"]
        flights = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        print(f"{' and '.join(FLIGHTS)} run beside these; what they print comes at the end", flush=True)
        try:
            code = run_pytest([f"--ignore={folder}" for folder in FLIGHTS])
            flights.wait()
        except KeyboardInterrupt:  # both have it
            code = 1
        finally:
            flights.terminate()
            flights.wait()
            output.seek(0)
            print(output.read(), flush=True)
    return max(code, 1 if flights.returncode else 0)


if __name__ == "__main__":
    sys.exit(main())
