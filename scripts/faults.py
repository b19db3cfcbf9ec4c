#!/usr/bin/env python3
"""Kill, stop and restart nodes in flight, disturb their messages, and record how each flight ends. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.graph_faults.campaign")
