#!/usr/bin/env python3
"""Run the benchmarks of perch and check whether the required values are met on this machine."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from perch_setup import ROOT, command_parser, enter, leave_quietly_on_interrupt
from perch_setup.enter import INTERRUPTED

GROUPS = ("planner", "perception", "control", "powerline", "sim", "autopilot", "ros")
EXAMPLES = """examples:
  python3 scripts/bench.py                          every group
  python3 scripts/bench.py planner                  one group
  python3 scripts/bench.py planner --json out.json  and the figures as JSON
  python3 scripts/bench.py planner --quick          fewer repetitions, for a first look

exit code: 0 every required value is met, 1 one is not or a group could not be measured, 2 wrong arguments, 130 Ctrl-C"""


def main() -> int:
    """Run the groups, print their tables, write the JSON."""
    parser = command_parser(__doc__, EXAMPLES)
    parser.add_argument("group", nargs="?", choices=GROUPS, metavar="GROUP", help=", ".join(GROUPS) + "; all when left out")
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write the figures to FILE")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions: the figures are rougher")
    arguments = parser.parse_args()
    if arguments.json:
        new = not arguments.json.exists()
        try:
            arguments.json.open("a").close()  # before minutes of measuring
            if new:
                arguments.json.unlink()
        except OSError as error:
            parser.error(f"--json {arguments.json}: cannot be written: {error.strerror}")
    enter()
    leave_quietly_on_interrupt()
    sys.path.insert(0, str(ROOT / "bench"))
    sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "oracles")]  # the closed loop and the oracles of the tests
    import harness
    from perch_core.json_values import write_json
    from perch_eval.revision import code_version, command_line

    code = code_version() if arguments.json else {}
    results, failed = {}, False
    for group in [arguments.group] if arguments.group else GROUPS:
        print(f"== {group}", flush=True)
        try:
            results[group] = importlib.import_module(group).figures(arguments.quick)  # bench/<group>.py
        except KeyboardInterrupt:  # in a node's wait
            return INTERRUPTED
        except Exception as error:  # a group that breaks must not hide the figures of the others
            print(f"error: {group}: {type(error).__name__}: {error}", file=sys.stderr)
            failed = True
            continue
        print(harness.table(results[group]), flush=True)
        failed |= any(item.holds is False for item in results[group])
    if arguments.json:
        seeds = {group: sys.modules[group].SEEDS for group in results}
        write_json(arguments.json, harness.as_json(results, code, command_line(), seeds))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
