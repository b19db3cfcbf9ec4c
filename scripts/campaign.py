#!/usr/bin/env python3
"""Fly many flights over drawn conditions and rank the causes of failure. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then fly; the options are those of `perch_eval.campaign.command`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.campaign.command import main as fly

    return fly()


if __name__ == "__main__":
    sys.exit(main())
