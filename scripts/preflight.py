#!/usr/bin/env python3
"""Check a running vehicle before it flies: one table of what passed, what failed and what to do. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then work; the options are those of `perch_eval.preflight.command`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.preflight.command import main as work

    return work()


if __name__ == "__main__":
    sys.exit(main())
