#!/usr/bin/env python3
"""Regenerate the papers' tables and figures beside the papers' values. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.evaluation.command")
