#!/usr/bin/env python3
"""Compare two recorded flights on one page. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.comparison")
