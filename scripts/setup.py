#!/usr/bin/env python3
"""Set perch up: virtual environment, locked packages, colcon workspace.

Every other script here does this by itself when it has to; this one does nothing else.
"""

from __future__ import annotations

from perch_setup import EXTRAS, ROOT, command_parser, prepare, setting_up

EXAMPLES = """examples:
  python3 scripts/setup.py            set up what is missing or out of date
  python3 scripts/setup.py --clean    start from nothing
  python3 scripts/setup.py --all      with all extra packages, for a machine that will be without network
  source setup.bash                   afterwards: a shell in which perch works
"""


def main() -> None:
    """Set up and print how to continue."""
    parser = command_parser(__doc__, EXAMPLES)
    parser.add_argument("--clean", action="store_true", help="remove .venv, build and install first")
    parser.add_argument("--extra", action="append", default=[], choices=EXTRAS,
                        help="packages that are otherwise installed by the script that needs them; repeatable")
    parser.add_argument("--all", action="store_true", help="all of these")
    arguments = parser.parse_args()
    with setting_up():
        platform = prepare(arguments.clean, EXTRAS if arguments.all else arguments.extra)
    source = "the ROS wheels of PyPI" if platform.uses_wheels else "the ROS installation"
    print(f"perch is set up with {source}. A shell in which it works:  source {ROOT / 'setup.bash'}")


if __name__ == "__main__":
    main()
