#!/usr/bin/env python3
"""Show a recorded flight as an animation and plots. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then draw; the options are those of `perch_eval.replay.command`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.replay.command import main as show

    return show()


if __name__ == "__main__":
    sys.exit(main())
