#!/usr/bin/env python3
"""Fly a scenario on the real nodes and report it. Sets everything up on first use; `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then fly; the options are those of `perch_eval.demo`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.demo import main as fly

    return fly()


if __name__ == "__main__":
    sys.exit(main())
