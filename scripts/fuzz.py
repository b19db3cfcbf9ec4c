#!/usr/bin/env python3
"""Search for inputs that crash or hang a component, or are accepted although invalid. Inputs found are kept as test cases."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from perch_setup import ROOT, command_parser, enter, quiet_on_interrupt
from perch_setup.enter import INTERRUPTED

EXAMPLES = """examples:
  python3 scripts/fuzz.py files                          a minute of mutated vehicles, scenarios, boards, campaigns, problems, parameter files, recordings
  python3 scripts/fuzz.py files --minutes 20 --seed 7
  python3 scripts/fuzz.py messages --minutes 20          values into every port of every component
  python3 scripts/fuzz.py services --cases /tmp/found    requests to the planners, the mission, the controller

exit code: 0 nothing found, 1 something found, 2 wrong arguments, 130 Ctrl-C"""


def main() -> int:
    """Fuzz inputs of one kind; the kinds are modules of tests/fuzzing."""
    kinds = sorted(path.stem for path in (ROOT / "tests" / "fuzzing").glob("*.py") if "\ndef run(" in path.read_text())
    parser = command_parser(__doc__, EXAMPLES)
    parser.add_argument("kind", choices=kinds, help="kind of input")
    parser.add_argument("--minutes", type=float, default=1.0, help="of the search (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="of the mutations (default: %(default)s)")
    parser.add_argument("--cases", type=Path, default=ROOT / "tests" / "fuzz" / "cases", metavar="DIR",
                        help="where inputs that are found are kept (default: tests/fuzz/cases)")
    arguments = parser.parse_args()
    if not 0.0 < arguments.minutes <= 1e5:
        parser.error(f"--minutes {arguments.minutes} is outside (0, 100000]")
    try:
        (arguments.cases / arguments.kind).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        parser.error(f"--cases {arguments.cases}: cannot be written: {error.strerror}")
    enter()
    sys.path.append(str(ROOT / "tests"))
    with quiet_on_interrupt():
        from fuzzing.report import Report

        fuzzer = importlib.import_module(f"fuzzing.{arguments.kind}")
    report = Report(arguments.kind, arguments.minutes, arguments.cases)
    try:
        fuzzer.run(arguments.minutes, arguments.seed, report)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    finally:
        print(f"{report.line().strip()}; {len(report.problems)} problems")
    return 1 if report.problems else 0


if __name__ == "__main__":
    sys.exit(main())
