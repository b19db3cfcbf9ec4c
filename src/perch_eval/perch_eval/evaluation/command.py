"""Regenerate the tables and figures of both papers, each value beside the paper's with a verdict."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from perch_core.registry import resolved
from perch_eval.arguments import command, command_parser, count, output_folder
from perch_eval.evaluation import document
from perch_eval.evaluation.document import FAILS, MISSING, Effort, Section
from perch_eval.revision import OtherCodeError

EXAMPLES = """examples:
  python3 scripts/evaluate.py                       both papers, 5 seeds a condition, 1 on lines
  python3 scripts/evaluate.py --seeds 20            20 seeds a condition
  python3 scripts/evaluate.py --full --jobs 2       100 seeds, and what goes beyond the papers; interrupted, the same command continues
  python3 scripts/evaluate.py --only m_planning     one part (m_planning, m_flights, p_powerline, p_flights, p_inspection,
                                                    p_cable, c_faults, c_comparison, c_way_out, c_contact, c_consistency)

exit code: 0 every claim holds and every row is there, 1 a claim fails, 3 no claim fails but rows are not available,
2 invalid input, 130 interrupted"""


PARTS = {
    "m_planning": "planning_times:planning_sections", "m_flights": "perching:perching_sections",
    "p_powerline": "powerline:powerline_sections", "p_flights": "powerline:flown_sections",
    "p_inspection": "inspection:inspection_sections", "p_cable": "cable:cable_sections",
    "c_faults": "control:fault_sections", "c_comparison": "control:comparison_sections",
    "c_way_out": "ways_out:sections", "c_contact": "contact:contact_sections", "c_consistency": "consistency:consistency_sections"}
"""Part -> `module:function` in this package that returns its sections, in the order of the page."""
FLIGHTS = {"seeds": ("flights of each perch condition", 5, 100), "line-seeds": ("flights of each powerline scenario", 1, 20),
           "layouts": ("random layouts of the inspection", 3, 20)}
"""Option -> (what it counts, default, default with --full)."""
BEYOND_PAPERS = ("c_faults", "c_comparison", "c_way_out", "c_contact", "c_consistency")
"""Parts with hundreds of additional flights, which are evaluated only with --full or by name."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    out = command_parser("evaluate.py", __doc__, EXAMPLES)
    out.add_argument("--full", action="store_true", help="every part, with many flights; resumable")
    out.add_argument("--jobs", type=count, default=os.cpu_count() or 1, metavar="N", help="processes for flights (default: %(default)s)")
    out.add_argument("--out", type=Path, metavar="DIR", help="folder of page, figures and JSON, replaced at the end (default: docs/results with --full and "
                                                              "without --only, otherwise out/results)")
    out.add_argument("--only", action="append", choices=PARTS, metavar="PART", help=f"{', '.join(PARTS)}; may be repeated")
    for name, (what, quick, full) in FLIGHTS.items():
        out.add_argument(f"--{name}", type=count, metavar="N", help=f"{what} (default: {quick}, with --full {full})")
    out.add_argument("--fresh", action="store_true", help="delete the flights that were kept, and fly all again")
    return out


def _regenerate(args: argparse.Namespace) -> int:
    # The page in docs/results is of all parts: fewer do not replace it by default.
    folder = args.out or (Path("docs/results") if args.full and not args.only else Path("out/results"))
    state = Path("out") / "evaluation" / ("full" if args.full else "quick")
    counts = {name: getattr(args, name.replace("-", "_")) or (full if args.full else quick) for name, (_, quick, full) in FLIGHTS.items()}
    made_by = ["python3 scripts/evaluate.py", *["--full"] * args.full, *(f"--{name} {n}" for name, n in counts.items()),
               *(f"--only {name}" for name in args.only or ()), f"--out {folder}"]
    began = time.monotonic()
    output_folder(folder), output_folder(state, "finished flights")
    for kept in state.glob("*.jsonl") if args.fresh else ():
        kept.unlink()
    with _draft(folder) as draft:
        effort = Effort(args.full, args.jobs, draft, state, " ".join(made_by), range(1, 1 + counts["seeds"]),
                        range(1, 1 + counts["line-seeds"]), counts["layouts"])
        sections = evaluate(effort, [name for name in PARTS if (name in args.only if args.only else args.full or name not in BEYOND_PAPERS)])
        document.write(sections, effort, time.monotonic() - began)
    found = document.counts(sections)
    print(f"results: {folder / 'README.md'}: " + ", ".join(f"{n} {verdict}" for verdict, n in found.items()))
    return 1 if found.get(FAILS) else 3 if found.get(MISSING) else 0


@contextmanager
def _draft(folder: Path) -> Iterator[Path]:
    """Yield a folder whose files replace those of `folder` at the end; after an error or Ctrl-C, `folder` is as before."""
    with tempfile.TemporaryDirectory(prefix=".draft-", dir=folder) as draft:
        yield Path(draft)
        for file in Path(draft).iterdir():
            file.replace(folder / file.name)


def evaluate(effort: Effort, names: list[str]) -> list[Section]:
    """Return the sections of some parts; a part that raises an error becomes a row `not available`, and the others continue.

    Raises:
        OtherCodeError: the code was changed meanwhile.
    """
    sections = []
    for k, name in enumerate(names):
        began = time.monotonic()
        print(f"[{k + 1}/{len(names)}] {name}", flush=True)
        try:
            part: list[Section] = resolved(f"perch_eval.evaluation.{PARTS[name]}")(effort)
        except OtherCodeError:
            raise
        except Exception as error:
            broken = Section(name, f"{name} could not be evaluated", "")
            broken.missing(name, "", f"{type(error).__name__}: {error}")
            part = [broken]
        for section in part:
            print(f"  {section.title}")
            for row in section.rows:
                print(f"    {row.verdict:<14} {row.name}: {row.ours}" + (f"  (paper: {row.paper})" if row.paper else ""), flush=True)
        print(f"  {time.monotonic() - began:.0f} s", flush=True)
        sections += part
    return sections


main = command(parser, _regenerate, interrupted="interrupted; finished flights are kept: the same command (without --fresh) continues")
