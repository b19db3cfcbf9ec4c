"""Campaign of faults on the real graph: fly the cases that have no result yet, and write the page of results."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_eval.arguments import command, command_parser, count, output_folder
from perch_eval.campaign.progress import Progress
from perch_eval.campaign.workers import in_processes
from perch_eval.ending import SAFE
from perch_eval.evaluation.document import machine, table
from perch_eval.graph_faults.cases import FAULTS, LOCKSTEP, MODES, PHASES, PROCESS, REAL_TIME, REPORT_LIMIT, TRAFFIC, Case, cases, judged_end
from perch_eval.graph_faults.flight import fly
from perch_eval.revision import banner, code_version
from perch_eval.rows import Rows, rows_of
from perch_sim.contact import CRASH_SPEED

EXAMPLES = """examples:
  python3 scripts/faults.py                                    all; interrupted or killed, the same command continues;
                                                               rows of other code are dropped first
  python3 scripts/faults.py --jobs 1                           one flight at a time
  python3 scripts/faults.py --most 20                          so many more
  python3 scripts/faults.py --only "kill estimator"            cases with these words in their names
  python3 scripts/faults.py --again --only "stop controller"   fly them once more
  python3 scripts/faults.py --page                             write the page of what has been flown

exit code: 0 every flight was flown, ended safely and its fault was named, 1 otherwise, 2 invalid input, 130 interrupted"""
ROWS = "rows.jsonl"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    out = command_parser("faults.py", __doc__, EXAMPLES)
    out.add_argument("--out", type=Path, default=Path("docs/results/faults"), metavar="DIR", help="rows and page (default: %(default)s)")
    out.add_argument("--logs", type=Path, default=Path("out/faults"), metavar="DIR", help="logs of the flights (default: %(default)s)")
    out.add_argument("--only", default="", metavar="WORDS", help="cases with all of these words in their names")
    out.add_argument("--most", type=count, metavar="N", help="fly at most so many")
    out.add_argument("--jobs", type=count, default=len(os.sched_getaffinity(0)), metavar="N", help="flights in lockstep at a time (default: %(default)s)")
    out.add_argument("--again", action="store_true", help="also repeat cases that have a result")
    out.add_argument("--page", action="store_true", help="write the page only, fly nothing")
    return out


def _run(args: argparse.Namespace) -> int:
    output_folder(args.out), output_folder(args.logs, "--logs")
    chosen = [case for case in cases() if all(word in case.name for word in args.only.split())]
    if not chosen:
        raise PerchError(f"--only {args.only}: no case has these words in its name")
    code = code_version()
    rows = load(args.out / ROWS, None if args.page else code["digest"])
    missing = [] if args.page else [case for case in chosen if args.again or case not in rows][:args.most]
    not_flown = fly_all(missing, args.out / ROWS, args.logs, rows, args.jobs, code) if missing else 0
    known = [rows[case] for case in cases() if case in rows]
    (args.out / "README.md").write_text(page(known))
    bad = [row for row in known if problems(row)]
    print(f"{args.out / 'README.md'}: {len(known)} of {len(cases())} flown, {len(known) - len(bad)} good")
    return 1 if bad or not_flown else 0


def load(file: Path, code: str | None = None) -> dict[Case, dict[str, Any]]:
    """Return the last row of each case flown so far, with its end judged; truncated lines, and flights that ended before their fault,
    do not count.

    Args:
        file: file with one row per line.
        code: digest of the code whose rows count; None: any code.
    """
    found = {}
    for row in rows_of(file):
        if row["struck"] is not None and code in (None, row.get("code")):
            found[Case(row["fault"], row["node"], row["phase"], row["mode"])] = row | {"end": judged_end(row["end"], row["impact"])}
    return found


def fly_all(missing: Sequence[Case], file: Path, logs: Path, rows: dict[Case, dict[str, Any]], jobs: int,
            code: Mapping[str, str]) -> int:
    """Fly cases: `jobs` at a time in lockstep, then one by one in real time, as parallel real-time flights lack processor time.
    Each row is written when its flight has ended, with the commit and digest of `code`.

    Returns:
        The number of cases that could not be flown.

    Raises:
        PerchError: the process of a flight died repeatedly.
    """
    not_flown = 0
    with closing(Rows(file, rows.values())) as kept, closing(Progress(len(missing), unit="flights")) as progress:
        for mode, at_once in ((LOCKSTEP, jobs), (REAL_TIME, 1)):
            for case, row in in_processes(partial(_fly, logs, code), [case for case in missing if case.mode == mode], at_once):
                if isinstance(row, dict):
                    rows[case] = row
                    kept.add(row)
                    progress.add(not problems(row))
                else:
                    not_flown += 1
                if words := [row] if isinstance(row, str) else problems(row):
                    print(f"\n{case.name}: {'; '.join(words)}", file=sys.stderr, flush=True)
    return not_flown


def _fly(logs: Path, code: Mapping[str, str], case: Case) -> dict[str, Any] | str:
    """Fly a case; return its row, or the reason why it was not flown."""
    folder = logs / case.name.replace(", ", "_").replace(" ", "_")
    for old in folder.glob("*.log"):
        old.unlink()
    try:
        return {**asdict(fly(case, folder, code["commit"])), "code": code["digest"]}
    except PerchError as error:
        return f"not flown: {error}"


def problems(row: dict[str, Any]) -> list[str]:
    """Return the problems of a flight; empty: none."""
    if row["struck"] is None:
        return [f"the flight ended before the fault: {row['goal']}"]
    found = [] if row["end"] in SAFE else [f"ended {row['end']}"]
    if not in_time(row) and not without_effect(row):
        found.append("not named" if row["named"] is None else f"named after {row['named']:.1f} s")
    found += [f"{name} ended, too" for name in row["ended"]] + [f"left: {one}" for one in row["left"]]
    return found


def in_time(row: dict[str, Any]) -> bool:
    """Return whether the fault was named in time."""
    return row["named"] is not None and row["named"] <= REPORT_LIMIT


def without_effect(row: dict[str, Any]) -> bool:
    """Return whether disturbed messages were not reported in time, but had no effect: the flight perched."""
    return row["fault"] in TRAFFIC and row["goal"].startswith("perched") and not in_time(row)


def _ends(rows: Sequence[dict[str, Any]]) -> str:
    counts = Counter(row["end"] if row["struck"] is not None else "not struck" for row in rows)
    return ", ".join(f"{counts[end]} {end}" for end in sorted(counts, key=lambda end: (end not in SAFE, -counts[end])))


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the page of results in Markdown."""
    struck = [row for row in rows if row["struck"] is not None]
    crashed = Counter(row["node"] for row in struck if row["end"] == "crashed")
    safe = [row for row in struck if row["end"] in SAFE]
    of_processes, of_messages = ([in_time(row) for row in struck if row["fault"] in kind] for kind in (PROCESS, TRAFFIC))
    unaffected = sum(map(without_effect, struck))
    clean = [row for row in rows if not row["left"]]
    commits, others = Counter(row["commit"] for row in rows), sum(bool(row["ended"]) for row in rows)
    text = ["# Faults on the real graph", "", banner(commits, [row.get("code", "") for row in rows]), "",
            "Made by `python3 scripts/faults.py`. This page is generated. Rows: [rows.jsonl](rows.jsonl).", "",
            f"{len(rows)} of {len(cases())} flights of `surface_90` at " + ", ".join(f"{name} ({n})" for name, n in commits.items())
            + f" on {machine()}.", "",
            f"* **{len(safe)} of {len(struck)} end safely**: hovering, landed, perched, or with the motors off on the ground.",
            *([f"  Crashed, with an impact of more than {CRASH_SPEED:g} m/s, {crashed.total()}; struck were: "
               + ", ".join(f"{node} ({n})" for node, n in crashed.items()) + "."] if crashed else []),
            f"* **{sum(of_processes)} of {len(of_processes)} faults of processes are named within {REPORT_LIMIT:g} s** of the wall clock, and "
            f"{sum(of_messages)} of {len(of_messages)} disturbances of messages:",
            "  a node, or the sender of the goal, names the missing node or messages. Reports by the faulted node or by the launcher",
            f"  are not counted. {unaffected} disturbances that are not named had no effect: the vehicle perched. These are no failures.",
            f"* **{len(clean)} of {len(rows)} leave no residue**: no process, no socket of the lockstep, no shared memory in the end.",
            "  Before it is counted, the campaign removes the shared memory of these processes that is unused, as `demo.py` does: one that is",
            "  killed cannot.",
            f"* In {others} flights a node that was not struck ended." if others else "* No other node ended in any flight.",
            "", "The node that is struck has a process of its own. In a quarter of the flights all others have, too; in the rest those",
            "that do not use images share one, as in `demo.py`. Cameras are off; VIO and tags are replaced by their error models",
            "(`perch_eval.modelled_sight_node`). Processes are forked from one that has loaded the code: a restart is quick.",
            "In lockstep a node that hangs is waited for 8 s instead of 60; a plan begins 1.5 s after its request instead of 0.1. The end",
            "is judged by the truth, for a hover by the controller's state, too, when it has lasted for 4 s. *motors off*: on the ground,",
            "tilted; without a controller no other node can hold the vehicle.", "",
            *table("fault | what happens", FAULTS.items()), "",
            "Messages are disturbed by a relay between publisher and subscribers, which lockstep does not have (its batches go over",
            f"sockets of their own): in real time only. Phases: {', '.join(PHASES)}; messages are disturbed in search and approach, from",
            "then on.", ""]
    for mode in MODES:
        nodes = list(dict.fromkeys(case.node for case in cases() if case.mode == mode))
        ends = [(fault, *(_ends([row for row in rows if (row["fault"], row["node"], row["mode"]) == (fault, node, mode)]) for node in nodes))
                for fault in FAULTS]
        text += [f"## How flights ended, {mode}", "", *table(" | ".join(("fault", *nodes)), (row for row in ends if any(row[1:]))), ""]
    times = sorted(row["named"] for row in struck if row["named"] is not None)
    if times:
        text += [f"Time until the fault was named: median {times[len(times) // 2]:.1f} s, worst {times[-1]:.1f} s.", ""]
    bad = [f"* **{row['fault']} {row['node']}, {row['phase']}, {row['mode']}** (seed {row['seed']}): {'; '.join(problems(row))}. "
           f"Goal: {row['goal']}" for row in rows if problems(row)]
    text += ["## Failed flights", "", *(bad or ["None."])]
    return "\n".join(text) + "\n"


main = command(parser, _run, ValueError, interrupted="interrupted; what has been flown is kept, the same command continues")
