"""Fly a scenario on the real nodes and write a report."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

from perch_autopilot import firmware
from perch_core import config
from perch_core.errors import ConfigError, PerchError
from perch_core.jit import uncompiled
from perch_core.vehicle import load_vehicle
from perch_eval.arguments import command, command_parser, locked_folder, open_network
from perch_eval.campaign.causes import SUCCESS
from perch_eval.domain import domain_in_environment
from perch_eval.flyable import check_flight
from perch_eval.nodes import CHAIN_NODES, FAST_NODES, programs, sharing
from perch_eval.ros.mission_client import FlightResult, MissionClient
from perch_eval.stack import Stack, StackError
from perch_sim.scenario import Scenario, load_scenario

READY_TIMEOUT = 300.0  # [s] compiled functions that a changed source invalidated are built while nodes start
EXAMPLES = """examples:
  python3 scripts/demo.py                                    perch on the wall of paper M, 1.7 m away
  python3 scripts/demo.py --scenario surface_60_far --seed 4 --out /tmp/flight
  python3 scripts/demo.py --scenario my_surface.yaml         your own scenario file
  python3 scripts/demo.py --vehicle betaflight               behind Betaflight's own firmware, which is built on first use
"""


def parser() -> argparse.ArgumentParser:
    """The command line of the demo."""
    out = command_parser("demo.py", __doc__, EXAMPLES)
    out.add_argument("--scenario", default="surface_90", help="name in config/scenarios, or a YAML file (default: %(default)s)")
    out.add_argument("--vehicle", default="", help="name in config/vehicles, or a YAML file (default: the scenario's)")
    out.add_argument("--seed", type=int, default=1, help="seed of noise, calibration and textures (default: %(default)s)")
    out.add_argument("--out", type=Path, default=Path("out"), help="folder for report, recording and logs (default: ./%(default)s)")
    layout = out.add_mutually_exclusive_group()
    layout.add_argument("--composed", nargs="*", metavar="NODE",
                        help="nodes that share a process; all without names (default: " + ", ".join(FAST_NODES) + "; with --realtime "
                             + ", ".join(CHAIN_NODES) + ")")
    layout.add_argument("--separate", action="store_true", help="every node in a process of its own")
    out.add_argument("--realtime", action="store_true", help="paced by the wall clock instead of lockstep")
    out.add_argument("--network", metavar="ADDRESS", help="open the ROS graph to the network in which this machine has this address (SECURITY.md)")
    out.add_argument("--verbose", action="store_true", help="show the nodes' output")
    return out


def fly(scenario_name: str, seed: int, out: Path, composed: Collection[str] = FAST_NODES, realtime: bool = False,
        verbose: bool = False, vehicle: str = "") -> dict:
    """Fly a scenario once, write the report to `out` and return its content.

    Args:
        scenario_name: name in config/scenarios, or a file.
        seed: of every random number.
        out: folder of report, recording and logs.
        composed: nodes that share a process; the others have one each.
        realtime: paced by the wall clock instead of lockstep.
        verbose: show the nodes' output.
        vehicle: name in config/vehicles, or a file; empty: the scenario's.

    Raises:
        ConfigError: the scenario, the seed or the folder is refused.
        PerchError: a node to compose does not exist.
        StackError: a node refused its parameters.
    """
    source = config.find("scenarios", scenario_name)
    scenario = load_scenario(source)
    if vehicle:
        found = config.find("vehicles", vehicle)
        scenario = replace(scenario, vehicle=str(found.resolve()) if vehicle.endswith((".yaml", ".yml")) else vehicle)
    with uncompiled():
        check_flight(scenario, source)
    if load_vehicle(scenario.vehicle).actuation.firmware:
        firmware.ensure_program()
    if not 0 <= seed < 2**31:
        raise ConfigError("--seed", str(seed), "is outside [0, 2147483647]")
    on_line = (lambda name, line: print(f"  [{name}] {line}", flush=True)) if verbose else (lambda name, line: None)
    with locked_folder(out):
        with domain_in_environment(), _replaced(out / "flight.mcap"):
            started = programs(scenario, seed, folder=out / "logs", scenario_source=str(source.resolve()), composed=composed, lockstep=not realtime,
                               record=out / "flight.mcap", hold_for_goal=not realtime)
            stack = Stack(started, out / "logs", on_line=on_line)
            print(f"{scenario.name}, seed {seed}: starting {len(started)} processes", flush=True)
            with stack:
                from perch_eval.report import build_report  # and with it matplotlib, while the nodes start
                result = _fly_stack(scenario, stack)
        return build_report(out, scenario, seed, result.outcome, result.message, result.wall_time, result.end_time,
                            result.start_time)


@contextmanager
def _replaced(recording: Path) -> Iterator[None]:
    """Move an earlier recording aside; restore it after a `PerchError`, or where this flight is interrupted before it records."""
    aside = recording.with_suffix(".earlier")
    if recording.exists():
        recording.replace(aside)
    try:
        yield
    except BaseException as error:
        if aside.exists() and (isinstance(error, PerchError) or not recording.exists()):
            aside.replace(recording)
        raise
    finally:
        aside.unlink(missing_ok=True)


def _fly_stack(scenario: Scenario, stack: Stack) -> FlightResult:
    """Send the goal to a started stack. An aborted flight is a result as well, unless a program refused its parameters."""
    with closing(MissionClient()) as client:
        try:
            stack.wait_until_ready(client.visible_nodes, timeout=READY_TIMEOUT)
            result = client.fly(scenario, lambda t, phase, text: print(f"  {t:7.2f} s  {phase:<10} {text}", flush=True), stack.raise_if_ended)
            client.linger(0.5)
            return result
        except PerchError as error:
            if isinstance(error, StackError) and error.refused_input:
                raise
            return FlightResult("failed", str(error), client.time, math.nan)


def _demonstrate(args: argparse.Namespace) -> int:
    open_network(args.network)
    # Real time has deadlines at 500 Hz that the work of more neighbours in the same process would miss.
    composed = sharing(args.composed, otherwise=() if args.separate else CHAIN_NODES if args.realtime else FAST_NODES)
    report = fly(args.scenario, args.seed, args.out, composed, args.realtime, args.verbose, args.vehicle)
    from perch_eval.report import outcome_text, summary
    print(f"outcome: {outcome_text(report)}")
    print("".join(f"  {name}: {text}\n" for name, text in summary(report)), end="")
    if "unwritten" in report:
        print(f"error: {report['unwritten']}", file=sys.stderr)
        return 2
    print(f"report: {args.out / 'report.html'}")
    return 0 if report["cause"] == SUCCESS else 1


main = command(parser, _demonstrate, interrupted="interrupted; all nodes are stopped")


if __name__ == "__main__":
    sys.exit(main())
