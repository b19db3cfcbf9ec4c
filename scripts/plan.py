#!/usr/bin/env python3
"""Plan a perch from a YAML file, without a graph: writes samples (CSV), coefficients and certificates (JSON), a picture (PNG)."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from perch_setup import command_parser, enter, leave_quietly_on_interrupt

EXAMPLES = """examples:
  python3 scripts/plan.py surface_90                       config/problems/surface_90.yaml, results in out/plan
  python3 scripts/plan.py my_problem.yaml --out results    a file of your own
  python3 scripts/plan.py surface_90 --set objective=jerk --set thrust_max=4.5
  python3 scripts/plan.py powerline_line_180 --animation   a powerline perch with its recovery, as a film too
  python3 scripts/plan.py --list                           the problems there are

files: plan.csv, plan.json (coefficients or figures, certificates), plan.png; powerline: visibility.png, plan.gif
exit code: 0 planned, 1 refused (the reason on stderr), 2 wrong arguments or file, 3 the independent verifier refuses the plan,
130 Ctrl-C"""


def _plan_perch(mapping: dict, source: str, out: Path, animation: bool) -> int:
    from perch_core.json_values import write_json
    from perch_eval.arguments import output_folder
    from perch_planner import plan_output
    from perch_planner.planner import plan
    from perch_planner.problem import Limits
    from perch_planner.problem_file import read_problem
    from perch_planner.verifier import verify

    problem, settings, vehicle = read_problem(mapping, source)
    plan(problem, settings, vehicle)  # loads the compiled kernels: the second plan is timed
    planned = plan(problem, settings, vehicle)
    output_folder(out)
    plan_output.write_csv(out / "plan.csv", planned, vehicle.mass)
    write_json(out / "plan.json", plan_output.as_json(planned))
    plan_output.draw(out / "plan.png", planned, problem, Limits.of(settings, vehicle), vehicle)
    print(f"contact after {planned.duration:.3f} s; {planned.iterations} programs in {1e3 * planned.solve_time:.2f} ms")
    for certificate in planned.certificates:
        print(f"  {certificate}")
    broken = verify(planned.trajectory.durations, planned.trajectory.coefficients, plan_output.requirements(problem, settings, vehicle))
    for finding in broken:
        print(f"the verifier refuses it: {finding.requirement} broken by {finding.excess:.3g} at {finding.time:.3f} s", file=sys.stderr)
    if not broken:
        print("the independent verifier finds nothing broken")
    print("written: " + ", ".join(str(out / name) for name in ("plan.csv", "plan.json", "plan.png")))
    return 3 if broken else 0


def _plan_powerline(mapping: dict, source: str, out: Path, animation: bool) -> int:
    from perch_core import config
    from perch_eval.arguments import output_folder
    from perch_planner.powerline import problem
    from perch_planner.powerline.report import write_report

    planned = problem.plan(config.from_mapping(problem.PowerlineProblem, mapping, source))
    written = write_report(planned, output_folder(out), animation)
    for name in ("perch", "recovery"):
        part = getattr(planned.plan, name)
        if part is not None:
            print(f"{name} of {part.duration:.3f} s; {part.solver}, {part.iterations} iterations in {1e3 * part.solve_time:.0f} ms")
    for bound in planned.plan.bounds:
        print(f"  {bound}")
    summary = written.get("visibility")
    if summary is not None:
        print(f"line in front {100 * summary['cheirality_share']:.0f} %, nearest point on its segment {100 * summary['segment_share']:.0f} %, "
              f"in the image {100 * summary['seen_share']:.0f} % of the perch; mean |reprojection| {summary['mean_reprojection_px']:.0f} px")
    print("written: " + ", ".join(written["files"]))
    return 0


KINDS = {"perch": _plan_perch, "powerline": _plan_powerline}


def _apply(mapping: dict, changes: list[str]) -> None:
    """Put `key=value` pairs into the section `settings`; dots separate groups."""
    from perch_core.config import flattened, nested, parse_yaml
    from perch_core.errors import ConfigError

    for change in changes:
        key, sign, value = change.partition("=")
        if not sign:
            raise ConfigError("--set", change, "is not KEY=VALUE")
        settings = mapping.get("settings") or {}
        if not isinstance(settings, dict):
            return  # refused with the rest of the file
        mapping["settings"] = nested(flattened(settings) | {key: parse_yaml(value, f"--set: {change}")})


def main() -> int:
    """Plan what the command line names."""
    parser = command_parser(__doc__, EXAMPLES)
    parser.add_argument("problem", nargs="?", help="name in config/problems, or a YAML file")
    parser.add_argument("--out", type=Path, default=Path("out/plan"), help="folder for the results (default: %(default)s)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="replace a setting of the planner; repeatable")
    parser.add_argument("--animation", action="store_true", help="powerline: also write plan.gif")
    parser.add_argument("--list", action="store_true", help="name the problems in config/problems")
    arguments = parser.parse_args()
    if not arguments.list and arguments.problem is None:
        parser.error("a problem is needed; --list names those there are")
    enter()
    leave_quietly_on_interrupt()
    from perch_eval.arguments import command

    return command(lambda: parser, plan_file)()


def plan_file(arguments: argparse.Namespace) -> int:
    """Read the problem, plan by its kind, write the files."""
    from perch_core import config
    from perch_core.errors import ConfigError, PlanningRefusal

    if arguments.list:
        print("\n".join(sorted(path.stem for path in (config.config_dir() / "problems").glob("*.yaml"))))
        return 0
    path = config.find("problems", arguments.problem)
    mapping = config.read_yaml(path)
    kind = mapping.get("kind") if isinstance(mapping, dict) else mapping
    if not isinstance(kind, str) or kind not in KINDS:
        raise ConfigError(str(path), "kind", f"{kind!r} is not one of {', '.join(KINDS)}")
    mapping |= {key: config.beside(path, mapping[key]) for key in {"vehicle"} & set(mapping)}
    _apply(mapping, arguments.set)
    if arguments.animation and kind != "powerline":
        raise ConfigError("--animation", arguments.problem, "only problems of kind powerline are animated")
    source = " ".join([str(path), *(f"--set {change}" for change in arguments.set)])
    try:
        return KINDS[kind](mapping, source, arguments.out, arguments.animation)
    except PlanningRefusal as refusal:
        print(f"refused ({refusal.code}): {refusal}", file=sys.stderr)
        return 2 if refusal.code == "bad_input" else 1


if __name__ == "__main__":
    sys.exit(main())
