#!/usr/bin/env python3
"""Plan thousands of random perches and check every answer.

Plans are checked by the independent verifier, refusals by planning again with the values that they name.

    nice -n 10 python3 bench/planner_campaign.py --count 10000 --step 1e-3 --out docs/results/planner/campaign.json

Takes about 0.1 s per problem; it can be stopped at any time (Ctrl-C, kill) and still writes what it has.
"""

from __future__ import annotations

import argparse
import shlex
import signal
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from random_perches import random_problem, shipped_settings

from perch_core import config
from perch_core.json_values import to_text, write_json
from perch_core.vehicle import load_vehicle
from perch_eval.evaluation.document import machine
from perch_eval.revision import code_version
from perch_planner.planner import plan
from perch_planner.problem import PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.plan_output import requirements
from perch_planner.verifier import verify


def confirmed(problem, refusal: PerchRefusal, settings: PerchSettings, vehicle) -> bool:
    """Return whether planning succeeds with the values that the refusal names, or it was refused before solving any program."""
    if not refusal.relaxed:
        return refusal.iterations == 0
    try:
        plan(problem, config.replace(settings, **refusal.relaxed), vehicle)
    except PerchRefusal:
        return False
    return True


def main() -> int:
    """Run the campaign and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10000, help="problems (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first problem (default: %(default)s)")
    parser.add_argument("--step", type=float, default=1e-4, help="sampling of the verifier [s] (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    arguments = parser.parse_args()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    code, vehicle, settings = code_version(), load_vehicle("snapdragon"), shipped_settings()
    codes, broken, unconfirmed, exceptions, times, durations, done = Counter(), [], [], [], [], [], 0
    begin = time.time()
    try:
        for seed in range(arguments.first, arguments.first + arguments.count):
            problem = random_problem(np.random.default_rng(seed))
            started = time.perf_counter()
            try:
                answer = plan(problem, settings, vehicle)
            except PerchRefusal as refusal:
                codes[refusal.code] += 1
                if not confirmed(problem, refusal, settings, vehicle):
                    unconfirmed.append([seed, refusal.code, refusal.constraint])
            except Exception as error:  # the campaign exists to find these
                exceptions.append([seed, repr(error)])
            else:
                times.append(time.perf_counter() - started)
                durations.append(answer.duration)
                need = requirements(problem, settings, vehicle)
                findings = verify(answer.trajectory.durations, answer.trajectory.coefficients, need, arguments.step)
                broken += [[seed, f.requirement, f.excess, f.time] for f in findings]
            done += 1
            if done % 500 == 0:
                print(f"{done}: {len(times)} plans, {len(broken)} findings, {dict(codes)}, {len(unconfirmed)} unconfirmed, "
                      f"{len(exceptions)} exceptions, {time.time() - begin:.0f} s", flush=True)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
    ms = 1e3 * np.array(times or [np.nan])
    result = {**code, "machine": machine(), "command": shlex.join(["python3", *sys.argv]),
              "problems": done, "first_seed": arguments.first, "plans": len(times), "refusals": dict(codes),
              "findings_of_the_verifier": broken, "unconfirmed_refusals": unconfirmed, "exceptions": exceptions,
              "plan_ms": {"median": float(np.median(ms)), "p90": float(np.percentile(ms, 90)), "max": float(ms.max())},
              "duration_s_median": float(np.median(durations or [np.nan])), "wall_clock_s": round(time.time() - begin, 1)}
    print(to_text(result), end="")
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(arguments.out, result)
    return 1 if broken or unconfirmed or exceptions or not done else 0


if __name__ == "__main__":
    sys.exit(main())
