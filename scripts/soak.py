#!/usr/bin/env python3
"""Perch, depart and perch again in one run of the stack, and see whether anything grows. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then fly; the options are those of `perch_eval.soak`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.soak import main as soak

    return soak()


if __name__ == "__main__":
    sys.exit(main())
