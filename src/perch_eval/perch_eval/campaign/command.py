"""Fly a campaign: many flights under randomised conditions, classified failures, one results file, one HTML report."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from contextlib import closing
from pathlib import Path

from perch_eval.arguments import command, command_parser, count, output_folder
from perch_eval.campaign.causes import ERROR, MEANING, SUCCESS
from perch_eval.campaign.engines import ENGINES, Task, resolve, run_task, source_digest
from perch_eval.campaign.progress import with_progress
from perch_eval.campaign.results import Results, RunResult, flight_folder, worst
from perch_eval.campaign.specification import Campaign, load_campaign
from perch_eval.campaign.workers import in_pool, on_cluster
from perch_eval.revision import digest
from perch_eval.statistics import Rate

EXAMPLES = """examples:
  python3 scripts/campaign.py contact                           config/campaigns/contact.yaml, in process, on all cores
  python3 scripts/campaign.py my.yaml --engine stack --jobs 1   the real nodes, each flight in a ROS domain of its own
  python3 scripts/campaign.py contact --resume                  go on after an interruption
  python3 scripts/campaign.py contact --cluster tcp://host:8786 on a Dask cluster

exit code: 0 every run was flown (whatever came of it), 1 some could not be carried out, 2 invalid input,
130 interrupted (results so far are kept; --resume continues)"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    out = command_parser("campaign.py", __doc__, EXAMPLES)
    out.add_argument("campaign", metavar="CAMPAIGN", help="name in config/campaigns, or a YAML file")
    out.add_argument("--engine", metavar="NAME", help=f"{' or '.join(ENGINES)}, or your own as module:function (default: the file's)")
    out.add_argument("--runs", type=count, metavar="N", help="flights, with grids per grid point (default: the file's)")
    out.add_argument("--jobs", type=count, default=os.cpu_count() or 1, metavar="N", help="processes (default: %(default)s)")
    out.add_argument("--cluster", metavar="ADDRESS", help="Dask scheduler (SECURITY.md)")
    out.add_argument("--resume", action="store_true", help="continue with the results in --out, of the same code; what could not be carried out is repeated")
    out.add_argument("--out", type=Path, metavar="DIR", help="folder of results and report (default: out/campaigns/<name>)")
    return out


def _run_campaign(args: argparse.Namespace) -> int:
    campaign = load_campaign(args.campaign, args.engine, args.runs)
    resolve(campaign.engine)
    out = output_folder(args.out or Path("out") / "campaigns" / campaign.name)
    file = out / "results.jsonl"
    with closing(Results(file, campaign.name, f"{campaign.digest} {digest()} {source_digest(campaign.engine)}".strip(), args.resume)) as results:
        try:
            fly_all(campaign, results, args.jobs, args.cluster)
            from perch_eval.campaign.report import write_report  # draws figures: not needed before, nor by workers

            found = results.all()
            keep_worst(campaign, found, out)
            report = write_report(campaign, found, out)
        except KeyboardInterrupt:
            print(f"\ninterrupted: {len(results.finished)} of {len(campaign.runs)} results are in {file}; continue with --resume", file=sys.stderr)
            return 130
    print(summary(found))
    print(f"results: {file}\nreport: {report}")
    return 1 if any(r.cause == ERROR for r in found) else 0


def fly_all(campaign: Campaign, results: Results, jobs: int, cluster: str | None) -> None:
    """Fly every run that was not carried out yet.

    Raises:
        PerchError: the cluster does not answer.
        KeyboardInterrupt: interrupted; the results of finished runs are written.
    """
    finished = results.finished
    tasks = [Task.from_campaign(campaign, run) for run in campaign.runs if run.number not in finished]
    print(f"{campaign.name}: {len(tasks)} of {len(campaign.runs)} runs to fly on {campaign.engine}, "
          + (f"Dask {cluster}" if cluster else f"{jobs} process{'es' if jobs > 1 else ''}"), flush=True)
    flown = on_cluster(tasks, cluster) if cluster else in_pool(tasks, jobs)
    good = sum(r.cause == SUCCESS for r in results.all())
    for result in with_progress(flown, len(campaign.runs), lambda r: r.cause == SUCCESS, initial=len(finished), initial_good=good):
        results.add(result)


def keep_worst(campaign: Campaign, found: list[RunResult], out: Path) -> None:
    """Repeat the worst flights with a recording and a report each; the same seed gives the same flight."""
    by_number = {run.number: run for run in campaign.runs}
    for result in worst(found, campaign.keep_worst):
        folder = out / flight_folder(result.number)
        if not (folder / "report.html").exists() and campaign.engine in ENGINES:
            run_task(Task.from_campaign(campaign, by_number[result.number], str(folder)))


def summary(found: list[RunResult]) -> str:
    """Return the success rate and the causes of failure as text, most frequent cause first."""
    rate = Rate.from_outcomes(r.cause == SUCCESS for r in found)
    lines = [f"success: {rate}  (95 % Wilson)"]
    for cause, flights in Counter(r.cause for r in found if r.cause != SUCCESS).most_common():
        lines.append(f"  {flights:5d}  {cause:<11} {MEANING.get(cause, '')}")
    return "\n".join(lines)


main = command(parser, _run_campaign)
