#!/usr/bin/env python3
"""Fly a scenario on the real nodes and report it. Sets everything up on first use; `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.demo")
