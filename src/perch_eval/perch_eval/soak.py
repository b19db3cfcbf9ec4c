"""Run the stack for hours (perch, depart, perch again); record memory, descriptors, threads and shared memory."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from perch_core import config
from perch_core.errors import PerchError
from perch_eval.arguments import command, command_parser, count, output_folder
from perch_eval.campaign.progress import Progress
from perch_eval.domain import domain_in_environment
from perch_eval.evaluation.document import machine, table
from perch_eval.modelled_sight_node import imageless_launches, imageless_programs
from perch_eval.nodes import FAST_NODES, node_programs, programs, sharing
from perch_eval.revision import banner, code_version, command_line
from perch_eval.ros.mission_client import MissionClient
from perch_eval.stack import Stack, StackError
from perch_sim.scenario import load_scenario

EXAMPLES = """examples:
  python3 scripts/soak.py                                       an hour of flight, without cameras
  python3 scripts/soak.py --scenario line_80 --flights 10
  python3 scripts/soak.py --cameras --hours 0.1 --name cameras

exit code: 0 every perch and departure succeeded, and nothing grows (memory is judged from 70 flights on); 1 otherwise; 2 invalid input;
130 interrupted (what has been flown is written)"""
WARM_UP_FLIGHTS = 50          # after which memory must not grow
JUDGED_FLIGHTS = 20           # after these, that growth is judged by at least
MAX_GROWTH = 1.0              # of a process, or of /dev/shm, per 100 flights [MB]
READY_TIMEOUT = 180.0         # [s]
MAX_CONSECUTIVE_FAILURES = 5  # after which it ends
SAVE_EVERY = 20               # flights after which what has been measured is written
CAPTION = "Memory, descriptors and threads of each process, and size of /dev/shm, over the number of the flight"


@dataclass(frozen=True)
class Sample:
    """One process at one moment.

    Attributes:
        rss: resident memory [MB].
        descriptors, threads: their numbers.
    """

    rss: float
    descriptors: int
    threads: int


@dataclass(frozen=True)
class Flight:
    """One perch and the departure after it.

    Attributes:
        time: simulation time at its end [s].
        outcome: of the goal; `perched` is success.
        departed: whether the vehicle has left for a hover.
        words: message of the failure; empty: none.
        processes: name -> its sample.
        shared: size of /dev/shm, with the files of all users [MB].
    """

    time: float
    outcome: str
    departed: bool
    words: str
    processes: Mapping[str, Sample]
    shared: float


def sample(pid: int) -> Sample:
    """Return a sample of a process."""
    process = psutil.Process(pid)
    return Sample(round(process.memory_info().rss / 1e6, 3), process.num_fds(), process.num_threads())


def slope(values: Sequence[float]) -> float | None:
    """Return the growth per 100 flights, without the first `WARM_UP_FLIGHTS`, by least squares; None if there are too few flights."""
    rest = np.asarray(values[WARM_UP_FLIGHTS:], float)
    return float(100.0 * np.polyfit(np.arange(len(rest)), rest, 1)[0]) if len(rest) >= JUDGED_FLIGHTS else None


def fly(name: str, seed: int, cameras: bool, composed: Collection[str], hours: float, flights: int | None, folder: Path,
        save: Callable[[Sequence[Flight]], object]) -> list[Flight]:
    """Fly until a simulated time or number of flights is reached, failures repeat, or the stack fails; save what was flown when
    interrupted.

    Args:
        name: of the scenario.
        seed: of every random number.
        cameras: render and process images; otherwise error models replace them.
        composed: nodes that share a process.
        hours: of simulated time.
        flights: maximum number of flights; None: no limit.
        folder: receives logs and parameters.
        save: called every `SAVE_EVERY` flights with all flights so far, to save them, and with those before an interrupt.

    Raises:
        KeyboardInterrupt: interrupted.
        PerchError: scenario or nodes are refused, the workspace is not built, or no ROS domain is free.
    """
    source = config.find("scenarios", name)
    scenario = load_scenario(source)
    found: list[Flight] = []
    if cameras:
        started = programs(scenario, seed, scenario_source=str(source), composed=composed, folder=folder)
    else:
        started = imageless_programs(node_programs(imageless_launches(scenario, seed, str(source), True), folder, composed=composed))
    with domain_in_environment(range(43, 70)), closing(MissionClient()) as client, closing(Progress(flights, unit="flights")) as progress:
        try:
            with Stack(started, folder) as stack:
                stack.wait_until_ready(client.visible_nodes, READY_TIMEOUT)
                while client.time < 3600.0 * hours and (flights is None or len(found) < flights):
                    found.append(_fly_once(client, scenario, stack))
                    progress.add(found[-1].departed)
                    if len(found) % SAVE_EVERY == 0:
                        save(found)
                    if len(found) >= MAX_CONSECUTIVE_FAILURES and not any(flight.departed for flight in found[-MAX_CONSECUTIVE_FAILURES:]):
                        print(f"\n{MAX_CONSECUTIVE_FAILURES} failures in a row: {found[-1].words}", file=sys.stderr)
                        break
                    if not found[-1].departed and stack.endings():
                        break
        except StackError as error:
            print(f"\n{error}", file=sys.stderr)
        except KeyboardInterrupt:
            if found:
                save(found)
            raise
    return found


def _fly_once(client: MissionClient, scenario: Any, stack: Stack) -> Flight:
    outcome, error, departed = "failed", "", False
    try:
        result = client.fly(scenario, check=stack.raise_if_ended)
        outcome, error = result.outcome, "" if result.outcome == "perched" else result.message
        if outcome in ("perched", "perched_already"):
            departed, message = client.depart(stack.raise_if_ended)
            error = error or ("" if departed else message)
        stack.raise_if_ended()
    except PerchError as exception:
        departed, error = False, str(exception)
    samples = {}
    for name, pid in stack.pids.items():
        with suppress(psutil.Error):  # it has just ended: the next flight fails
            samples[name] = sample(pid)
    return Flight(round(client.time, 3), outcome, departed, error, samples, round(shared_memory(), 3))


def shared_memory(folder: Path = Path("/dev/shm")) -> float:
    """Return the size of the files in shared memory [MB]."""
    size = 0
    for file in folder.iterdir():
        with suppress(OSError):  # it has been removed meanwhile
            size += file.stat().st_size if file.is_file() else 0
    return size / 1e6


def growth(flights: Sequence[Flight]) -> dict[str, dict[str, Any]]:
    """Return memory, its slope [MB per 100 flights], and the later range of descriptors and threads, of each process."""
    found = {}
    for name, own in _samples(flights).items():
        rest = own[min(WARM_UP_FLIGHTS, len(own) // 2):]
        found[name] = {"rss_first_MB": own[0].rss, "rss_last_MB": own[-1].rss, "slope_MB_per_100": slope([one.rss for one in own]),
                       "descriptors": [min(one.descriptors for one in rest), max(one.descriptors for one in rest)],
                       "threads": [min(one.threads for one in rest), max(one.threads for one in rest)]}
    return found


def _samples(flights: Sequence[Flight]) -> dict[str, list[Sample]]:
    """Return the samples of each process from the first flight on; after a process has ended there are none."""
    return {name: [flight.processes[name] for flight in flights if name in flight.processes] for name in flights[0].processes}


def find_problems(flights: Sequence[Flight]) -> list[str]:
    """Return the problems found, one line each."""
    found = [f"flight {k + 1}: {flight.outcome}{'' if flight.departed else ', no departure'}: {flight.words}"
             for k, flight in enumerate(flights) if not flight.departed or flight.outcome != "perched"]
    for name, figures in growth(flights).items():
        found += _growing(f"{name}: memory", figures["slope_MB_per_100"])
        for what in ("descriptors", "threads"):
            low, high = figures[what]
            found += [f"{name}: {what} between {low} and {high}"] if low != high else []
    return found + _growing("/dev/shm", slope([flight.shared for flight in flights]))


def _growing(what: str, per_100: float | None) -> list[str]:
    return [] if per_100 is None or per_100 <= MAX_GROWTH else [f"{what} grows by {per_100:.2f} MB per 100 flights"]


def not_judged(flights: int) -> list[str]:
    """Return, as one line, that so many flights are too few to judge the growth of memory; empty: they are enough."""
    needed = WARM_UP_FLIGHTS + JUDGED_FLIGHTS
    return [f"too few flights to judge growth of memory: {flights}, {needed} are needed"] if flights < needed else []


def plot(flights: Sequence[Flight], file: Path) -> None:
    """Memory, descriptors and threads of each process, and shared memory, by flight."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 8.0), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    x = np.arange(1, len(flights) + 1)
    for name, own in _samples(flights).items():
        axes[0].plot(x[:len(own)], [one.rss - own[0].rss for one in own], label=name)
        axes[1].plot(x[:len(own)], [one.descriptors for one in own])
        axes[2].plot(x[:len(own)], [one.threads for one in own])
    axes[3].plot(x, [flight.shared for flight in flights], "k")
    for ax, label in zip(axes, ("memory since the\nfirst flight [MB]", "descriptors", "threads", "/dev/shm [MB]")):
        ax.set_ylabel(label)
    axes[3].set_xlabel("flight")
    figure.legend(loc="outside upper center", fontsize=7, ncols=4)
    figure.savefig(file, dpi=110)


def page(folder: Path) -> str:
    """Return the page of all soak runs whose results are in a folder."""
    runs = {file: json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))}
    text = ["# Soak", "", banner([run["commit"] for run in runs.values()], [run.get("digest", "") for run in runs.values()]), "",
            "This page is generated. Each run is of the stack over ROS in lockstep: perch, depart, perch again. Growth of memory by",
            f"least squares over the flights after the first {WARM_UP_FLIGHTS}; required: at most {MAX_GROWTH:g} MB per 100 flights "
            "(of /dev/shm,",
            "too), descriptors and threads constant. Memory is what a process has resident; /dev/shm is that of the whole machine."]
    for file, run in runs.items():
        good = sum(flight["departed"] and flight["outcome"] == "perched" for flight in run["flights"])
        sight = "with cameras" if run["cameras"] else "without cameras (error models in their place)"
        minutes = run["flights"][-1]["time"] / 60.0
        text += ["", f"## {file.stem}", "", f"Made by `{run['command']}` on {run['machine']}, commit {run['commit']}.", "",
                 f"`{run['scenario']}`, seed {run['seed']}, {sight}.",
                 f"{good} of {len(run['flights'])} flights perched and departed, {minutes:.1f} min of simulated time in "
                 f"{run['wall_s'] / 60.0:.1f} min.",
                 "", *table("process | first [MB] | last [MB] | growth [MB per 100 flights] | descriptors | threads", (
                     (name, f"{figures['rss_first_MB']:.1f}", f"{figures['rss_last_MB']:.1f}", _growth_text(figures["slope_MB_per_100"]),
                      *(f"{low}" if low == high else f"{low} to {high}" for low, high in (figures["descriptors"], figures["threads"])))
                     for name, figures in run["growth"].items()))]
        shared = [flight["shared"] for flight in run["flights"]]
        bad = _grouped(run["problems"])
        verdict = ["Problems:", "", *(f"* {problem}" for problem in bad)] if bad else ["No problems."]
        verdict += [line for words in not_judged(len(shared)) for line in ("", f"{words.capitalize()}.")]
        text += ["", f"/dev/shm: {min(shared):.1f} to {max(shared):.1f} MB, growth per 100 flights [MB]: {_growth_text(slope(shared))}.", *verdict,
                 "", f"![{file.stem}]({file.stem}.png)", "", f"*{CAPTION}*"]
    return "\n".join(text) + "\n"


def _growth_text(per_100: float | None) -> str:
    return "too few flights" if per_100 is None else f"{per_100:+.2f}"


def _grouped(problems: list[str]) -> list[str]:
    """Merge equal problems of several flights."""
    flights: dict[str, list[str]] = {}
    for problem in problems:
        flight, _, text = problem.removeprefix("flight ").partition(": ") if problem.startswith("flight ") else ("", "", problem)
        flights.setdefault(text, []).append(flight)
    return [text if numbers == [""] else f"flight{'s' if len(numbers) > 1 else ''} {', '.join(numbers)}: {text}" for text, numbers in flights.items()]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("soak.py", __doc__, EXAMPLES)
    out.add_argument("--scenario", default="surface_90", help="name in config/scenarios, or a file (default: %(default)s)")
    out.add_argument("--seed", type=int, default=1, help="of every random number (default: %(default)s)")
    out.add_argument("--hours", type=float, default=1.0, help="of simulated time (default: %(default)s)")
    out.add_argument("--flights", type=count, metavar="N", help="at most so many")
    out.add_argument("--cameras", action="store_true", help="render and process images, too")
    out.add_argument("--composed", nargs="*", metavar="NODE",
                     help=f"nodes that share a process; all without names (default: {', '.join(FAST_NODES)})")
    out.add_argument("--name", help="of the run's files (default: the scenario's)")
    out.add_argument("--out", type=Path, default=Path("docs/results/soak"), metavar="DIR",
                     help="folder of figures and page (default: %(default)s)")
    out.add_argument("--logs", type=Path, default=Path("out/soak"), metavar="DIR", help="folder of logs (default: %(default)s)")
    return out


def _soak(args: argparse.Namespace) -> int:
    began = time.monotonic()
    if not 0.0 < args.hours <= 1000.0:
        raise PerchError(f"--hours {args.hours}: is outside (0, 1000]")
    output_folder(args.out), output_folder(args.logs, "--logs")
    write = partial(_write, args, code_version(), began)
    composed = sharing(args.composed, otherwise=FAST_NODES)
    flights = fly(args.scenario, args.seed, args.cameras, composed, args.hours, args.flights, args.logs, write)
    if not flights:
        raise PerchError(f"no flight was flown; logs: {args.logs}")
    problems = write(flights)
    print(f"{args.out / 'README.md'}: {len(flights)} flights", *problems, *not_judged(len(flights)), sep="\n  ")
    return 1 if problems else 0


def _write(args: argparse.Namespace, code: Mapping[str, str], began: float, flights: Sequence[Flight]) -> list[str]:
    """Write figures and page of the flights so far; return the problems found."""
    name, problems = args.name or Path(args.scenario).stem, find_problems(flights)
    plot(flights, args.out / f"{name}.png")
    (args.out / f"{name}.json").write_text(json.dumps({
        **code, "command": command_line(), "machine": machine(), "scenario": args.scenario, "seed": args.seed, "cameras": args.cameras,
        "wall_s": round(time.monotonic() - began, 1), "problems": problems, "growth": growth(flights),
        "flights": [asdict(flight) for flight in flights]}, separators=(",", ":")) + "\n")
    (args.out / "README.md").write_text(page(args.out))
    return problems


main = command(parser, _soak, psutil.Error, interrupted="\ninterrupted; what has been flown counts")
