#!/usr/bin/env python3
"""Regenerate the papers' tables and figures beside the papers' values. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then evaluate; the options are those of `perch_eval.evaluation.command`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.evaluation.command import main as evaluate

    return evaluate()


if __name__ == "__main__":
    sys.exit(main())
