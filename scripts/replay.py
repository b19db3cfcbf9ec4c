#!/usr/bin/env python3
"""Show a recorded flight as an animation and plots. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.replay.command")
