#!/usr/bin/env python3
"""Run all tests of perch. Sets everything up on first use.

Everything that is not an option of this script goes to pytest.
"""

from __future__ import annotations

import argparse
import os
import sys

from perch_setup import ROOT, enter

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
    import pytest

    skip = ["--ignore=tests/system"] if fast else []
    code = pytest.main([*skip, *for_pytest])
    return {0: 0, 1: 1}.get(int(code), 2 if code == pytest.ExitCode.USAGE_ERROR else 1)


if __name__ == "__main__":
    sys.exit(main())
