#!/usr/bin/env python3
"""Run perception on a recording of real sensors. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.recordings.command", "recordings")
