#!/usr/bin/env python3
"""Perch, depart and perch again in one run of the stack, and check for growth of its resources. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.soak")
