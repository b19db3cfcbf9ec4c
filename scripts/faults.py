#!/usr/bin/env python3
"""Kill, stop and restart nodes in flight, disturb their messages, and see how every flight ends. `--help` shows the options."""

from __future__ import annotations

import sys

from perch_setup import enter, quiet_on_interrupt


def main() -> int:
    """Set up, then fly; the options are those of `perch_eval.graph_faults.campaign`."""
    enter()
    with quiet_on_interrupt():
        from perch_eval.graph_faults.campaign import main as campaign

    return campaign()


if __name__ == "__main__":
    sys.exit(main())
