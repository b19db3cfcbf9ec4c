#!/usr/bin/env python3
"""Plan random perches and check every answer.

Plans are checked by the independent verifier, refusals by planning again with the values that they name. It can be stopped at
any time (Ctrl-C, kill) and still writes what it has.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections import Counter
from contextlib import nullcontext, suppress
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
    from perch_setup import enter, leave_quietly_on_interrupt

    enter()
    leave_quietly_on_interrupt()  # until the campaign begins

import harness
import numpy as np

from random_perches import random_problem, shipped_settings

from perch_core import config
from perch_core.errors import ConfigError
from perch_core.json_values import to_text, write_json
from perch_core.vehicle import load_vehicle
from perch_eval.arguments import command, command_parser, count, output_file
from perch_planner.planner import plan
from perch_planner.problem import PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.plan_output import requirements
from perch_planner.verifier import verify

EXAMPLES = """examples:
  nice -n 10 python3 bench/planner_campaign.py --count 10000 --step 1e-3 --out docs/results/planner/campaign.json
  python3 bench/planner_campaign.py --first 500123 --count 1        one problem again

exit code: 0 every answer is right, 1 one is not or there is none, 2 wrong arguments"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("planner_campaign.py", __doc__, EXAMPLES)
    out.add_argument("--count", type=count, default=10000, metavar="N", help="problems, about 0.1 s each (default: %(default)s)")
    out.add_argument("--first", type=int, default=0, metavar="SEED", help="of the first problem (default: %(default)s)")
    out.add_argument("--step", type=float, default=1e-4, metavar="S", help="sampling of the verifier [s] (default: %(default)s)")
    out.add_argument("--out", type=Path, metavar="FILE", help="write the figures as JSON")
    return out


def confirmed(problem, refusal: PerchRefusal, settings: PerchSettings, vehicle) -> bool:
    """Return whether planning succeeds with the values that the refusal names, or it was refused before solving any program."""
    if not refusal.relaxed:
        return refusal.iterations == 0
    try:
        plan(problem, config.replace(settings, **refusal.relaxed), vehicle)
    except PerchRefusal:
        return False
    return True


def campaign(arguments: argparse.Namespace) -> int:
    """Run the campaign and print its figures."""
    if arguments.first < 0:
        raise ConfigError("--first", str(arguments.first), "is not >= 0")
    if not 0.0 < arguments.step <= 0.1:
        raise ConfigError("--step", str(arguments.step), "is outside (0, 0.1] s")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    vehicle, settings = load_vehicle("snapdragon"), shipped_settings()
    codes, broken, unconfirmed, exceptions, times, durations, done = Counter(), [], [], [], [], [], 0

    def judge(seed: int) -> None:
        problem, started = random_problem(np.random.default_rng(seed)), time.perf_counter()
        try:
            answer = plan(problem, settings, vehicle)
        except PerchRefusal as refusal:
            codes[refusal.code] += 1
            if not confirmed(problem, refusal, settings, vehicle):
                unconfirmed.append([seed, refusal.code, refusal.constraint])
            return
        times.append(time.perf_counter() - started)
        durations.append(answer.duration)
        found = verify(answer.trajectory.durations, answer.trajectory.coefficients, requirements(problem, settings, vehicle), arguments.step)
        broken.extend([seed, finding.requirement, finding.excess, finding.time] for finding in found)

    with output_file(arguments.out) if arguments.out else nullcontext() as draft:
        head, begin = harness.provenance(), time.time()
        try:
            with suppress(Exception):  # loads the compiled kernels, which is no part of a plan's time
                plan(random_problem(np.random.default_rng(arguments.first)), settings, vehicle)
            for seed in range(arguments.first, arguments.first + arguments.count):
                try:
                    judge(seed)
                except Exception as error:  # the campaign exists to find these
                    exceptions.append([seed, repr(error)])
                done += 1
                if done % 500 == 0:
                    print(f"{done}: {len(times)} plans, {len(broken)} findings, {dict(codes)}, {len(unconfirmed)} unconfirmed, "
                          f"{len(exceptions)} exceptions, {time.time() - begin:.0f} s", flush=True)
        except KeyboardInterrupt:
            print("stopped", file=sys.stderr)
        ms = 1e3 * np.array(times or [np.nan])
        result = {**head, "problems": done, "first_seed": arguments.first, "plans": len(times), "refusals": dict(codes),
                  "findings_of_the_verifier": broken, "unconfirmed_refusals": unconfirmed, "exceptions": exceptions,
                  "plan_ms": {"median": float(np.median(ms)), "p90": float(np.percentile(ms, 90)), "max": float(ms.max())},
                  "duration_s_median": float(np.median(durations or [np.nan])), "wall_clock_s": round(time.time() - begin, 1)}
        print(to_text(result), end="")
        if draft:
            write_json(draft, result)
    return 1 if broken or unconfirmed or exceptions or not done else 0


main = command(parser, campaign)

if __name__ == "__main__":
    sys.exit(main())
