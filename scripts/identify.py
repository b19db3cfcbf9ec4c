#!/usr/bin/env python3
"""Identify lags, gains, thrust and drag of a vehicle from a flight. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then work; the options are those of `perch_eval.identification.command`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.identification.command import main as work

    return work()


if __name__ == "__main__":
    sys.exit(main())
