#!/usr/bin/env python3
"""Run the benchmarks of perch and check whether the required values are met on this machine."""

from __future__ import annotations

import argparse
import importlib
import sys
from contextlib import nullcontext
from pathlib import Path

from perch_setup import ROOT, command_parser, enter, quiet_on_interrupt

GROUPS = ("planner", "perception", "control", "powerline", "sim", "autopilot", "ros")
EXAMPLES = """examples:
  python3 scripts/bench.py                          every group
  python3 scripts/bench.py planner                  one group
  python3 scripts/bench.py planner --json out.json  and the figures as JSON
  python3 scripts/bench.py planner --quick          fewer repetitions, for a first look

exit code: 0 every required value is met, 1 one is not or a group could not be measured, 2 wrong arguments, 130 Ctrl-C"""


def main() -> int:
    """Measure the groups of the command line."""
    parser = command_parser(__doc__, EXAMPLES)
    parser.add_argument("group", nargs="?", choices=GROUPS, metavar="GROUP", help=", ".join(GROUPS) + "; all when left out")
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write the figures to FILE")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions: the figures are rougher")
    parser.parse_args()
    enter()
    with quiet_on_interrupt():
        from perch_eval.arguments import command

    return command(lambda: parser, measure)()


def measure(arguments: argparse.Namespace) -> int:
    """Run the groups, print their tables, write the JSON."""
    sys.path.insert(0, str(ROOT / "bench"))
    sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "oracles")]  # the closed loop and the oracles of the tests
    with quiet_on_interrupt():
        import harness
        from perch_core.json_values import write_json
        from perch_eval.arguments import output_file

    results, seeds, errors = {}, {}, {}
    with output_file(arguments.json, "--json") if arguments.json else nullcontext() as draft:
        begun = harness.provenance()  # the load is that of others
        for group in [arguments.group] if arguments.group else GROUPS:
            print(f"== {group}", flush=True)
            try:
                with quiet_on_interrupt():
                    module = importlib.import_module(group)  # bench/<group>.py
                results[group], seeds[group] = module.figures(arguments.quick), module.SEEDS
            except Exception as error:  # a group that breaks must not hide the figures of the others
                errors[group] = f"{type(error).__name__}: {error}"
                print(f"error: {group}: {errors[group]}", file=sys.stderr)
                continue
            print(harness.table(results[group]), flush=True)
        if draft:
            write_json(draft, begun | {"seeds": seeds, "errors": errors, "figures": harness.as_json(results)})
    return 1 if errors or any(item.holds is False for items in results.values() for item in items) else 0


if __name__ == "__main__":
    sys.exit(main())
