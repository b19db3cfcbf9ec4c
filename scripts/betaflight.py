#!/usr/bin/env python3
"""Betaflight as a program on this machine: build it, say where it is, or set a vehicle's autopilot up. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then work; the options are those of `perch_autopilot.command`."""
    enter()
    with quiet_on_interrupt():
        from perch_autopilot.command import main as work

    return work()


if __name__ == "__main__":
    sys.exit(main())
