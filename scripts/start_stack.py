#!/usr/bin/env python3
"""Start the nodes of a scenario, each in a process of its own unless --composed, and stop them all on Ctrl-C.

The nodes' output appears with the node's name in front; it is also kept, with the parameters, in the log folder.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from pathlib import Path

from perch_setup import ROOT, command_parser, enter, quiet_on_interrupt
from ros_graph.commands import is_absolute_name

EXAMPLES = """examples:
  python3 scripts/start_stack.py                                       scenario surface_90
  python3 scripts/start_stack.py --scenario my.yaml --seed 3 --composed
  python3 scripts/start_stack.py --composed vehicle estimator controller mission
  python3 scripts/start_stack.py --realtime --without mission          start it yourself (run_node.py)
  python3 scripts/start_stack.py --only vehicle --realtime
  python3 scripts/start_stack.py --composed --view                     watch it in Foxglove, ws://localhost:8765
  python3 scripts/start_stack.py -p vehicle.cameras:=none -p estimator.coasting_after:=0.3
  python3 scripts/start_stack.py --namespace /quad1 --domain 7

Other shells reach the nodes with the same ROS_DOMAIN_ID (42 by default, as in setup.bash).
exit code: 0 stopped by Ctrl-C, 1 a node ended or did not come up, 2 wrong arguments or input
"""
COLOURS = (36, 33, 32, 35, 34, 96, 93, 92, 95, 94, 31)


def command_line() -> argparse.ArgumentParser:
    """Options of the script."""
    parser = command_parser(__doc__, EXAMPLES)
    parser.add_argument("--scenario", default="surface_90", help="name in config/scenarios, or a file (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of every random number (default: 1)")
    parser.add_argument("--composed", nargs="*", metavar="NODE", help="nodes that share a process, all without names: faster")
    parser.add_argument("--only", nargs="+", default=[], metavar="NODE", help="start these instead of the scenario's nodes")
    parser.add_argument("--without", nargs="+", default=[], metavar="NODE", help="do not start these nodes")
    parser.add_argument("--realtime", action="store_true", help="pace by the wall clock instead of lockstep")
    parser.add_argument("--view", nargs="?", type=int, const=8765, metavar="PORT",
                        help="serve the flight to Foxglove at ws://localhost:PORT (8765); layout: config/foxglove_layout.json")
    parser.add_argument("--domain", type=int, metavar="N", help="ROS domain id, 0 to 101 (default: $ROS_DOMAIN_ID)")
    parser.add_argument("--network", metavar="ADDRESS", help="open the ROS graph to the network in which this machine has this address (SECURITY.md)")
    parser.add_argument("--namespace", default="", metavar="NS", help="namespace of every node, as in /quad1")
    parser.add_argument("--log-dir", type=Path, metavar="DIR", help="folder of logs and parameters (default: out/stack/<time>-<process>)")
    parser.add_argument("--ready-timeout", type=float, default=180.0, metavar="S", help="how long nodes may take to come up (default: %(default)g s)")
    parser.add_argument("-p", "--parameter", action="append", default=[], metavar="NODE.PARAM:=VALUE",
                        help="set a parameter, whatever the files say; repeatable")
    return parser


def main() -> int:
    """Run the script; return 0 if stopped by the caller, 1 if a node ended by itself, 2 if its input is refused."""
    parser = command_line()
    arguments = parser.parse_args()
    if arguments.domain is not None and not 0 <= arguments.domain <= 101:
        parser.error(f"--domain {arguments.domain} is outside [0, 101]")
    if arguments.view is not None and not 0 <= arguments.view <= 65535:
        parser.error(f"--view {arguments.view} is outside [0, 65535]")
    if not 0.0 < arguments.ready_timeout < math.inf:
        parser.error(f"--ready-timeout {arguments.ready_timeout} is not > 0 s")
    if arguments.namespace and not is_absolute_name(arguments.namespace):
        parser.error(f"--namespace {arguments.namespace}: must be '/' and a name of letters, digits and '_', as in /quad1")
    if arguments.domain is not None:
        os.environ["ROS_DOMAIN_ID"] = str(arguments.domain)
    enter(*["view"] * (arguments.view is not None or "viewer" in arguments.only))
    with quiet_on_interrupt():
        import ros_graph.connection  # noqa: F401  (what takes long, before anything is started)
        from perch_core.errors import PerchError
        from perch_eval.flyable import check_names  # noqa: F401
        from perch_eval.stack import StackError

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # stops like Ctrl-C
    try:
        run(arguments)
    except PerchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, StackError) and not error.refused_input else 2
    except KeyboardInterrupt:
        say("stopped")
        return 0
    return 1


def run(arguments: argparse.Namespace) -> None:
    """Start the nodes and watch them until the caller interrupts.

    Raises:
        PerchError: scenario, nodes or parameters are refused.
        StackError: a node ended, or did not become ready.
    """
    from perch_core import config
    from perch_sim.scenario import load_scenario
    from perch_eval.arguments import open_network, output_folder
    from perch_eval.flyable import check_names
    from perch_eval.node_launch import choose_nodes, node_launches, parse_overrides
    from perch_eval.nodes import node_programs, sharing
    from perch_eval.stack import Stack
    from perch_eval.view.gate import check_free
    from ros_graph.connection import connect

    open_network(arguments.network)
    source = config.find("scenarios", arguments.scenario).resolve()
    scenario = load_scenario(source)
    check_names(scenario, source)
    overrides = parse_overrides(arguments.parameter)
    if arguments.view is not None:
        viewer = overrides["viewer"] = {"port": arguments.view} | overrides.get("viewer", {})
        if viewer["port"] == arguments.view:
            check_free(str(viewer.get("host", "127.0.0.1")), arguments.view)
    nodes = choose_nodes(scenario, arguments.only, arguments.without, ("viewer",) if arguments.view is not None else ())
    launches = node_launches(scenario, nodes, seed=arguments.seed, scenario_source=str(source), lockstep=not arguments.realtime, overrides=overrides)
    folder = output_folder((arguments.log_dir or default_log_folder()).absolute(), "--log-dir")
    programs = node_programs(launches, folder, namespace=arguments.namespace, composed=sharing(arguments.composed))
    with Stack(programs, folder, on_line=printer([program.name for program in programs])) as stack:
        with connect() as graph:
            stack.wait_until_ready(graph.visible_nodes, arguments.ready_timeout)
        say(f"ready in ROS domain {os.environ['ROS_DOMAIN_ID']}: {', '.join(nodes)}. Logs: {folder}. Ctrl-C stops all.")
        stack.wait()
        stack.raise_if_ended()


def default_log_folder() -> Path:
    """Return the default log folder; it has the process id, as several stacks may start in the same second."""
    return ROOT / "out" / "stack" / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"


def printer(names: list[str]):
    """Return a function that prints lines with the program's name in front, in colour on a terminal."""
    width = max(map(len, names))
    colours = dict(zip(names, COLOURS * (1 + len(names) // len(COLOURS))))
    terminal = sys.stdout.isatty()

    def show(name: str, line: str) -> None:
        prefix = f"[{name:>{width}}]"
        say(f"\033[{colours[name]}m{prefix}\033[0m {line}" if terminal else f"{prefix} {line}")

    return show


def say(line: str) -> None:
    """Print a line; nothing once the reader of the output has ended (`... | tee` ends by Ctrl-C, too), as nodes go on until they have stopped."""
    from perch_core.processes import discard_closed_output

    try:
        print(line, flush=True)
    except BrokenPipeError:
        discard_closed_output()


if __name__ == "__main__":
    sys.exit(main())
