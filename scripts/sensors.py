#!/usr/bin/env python3
"""Make sensor files of calibrations, and check recordings. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then work; the options are those of `perch_eval.recordings.sensors_command`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.recordings.sensors_command import main as work

    return work()


if __name__ == "__main__":
    sys.exit(main())
