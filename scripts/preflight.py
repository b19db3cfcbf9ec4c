#!/usr/bin/env python3
"""Check a running vehicle before it flies: one table of what passed, what failed and what to do. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.preflight.command")
