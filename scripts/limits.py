#!/usr/bin/env python3
"""Write docs/limits.md: sizes, counts, magnitudes and rates of everything that enters."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.limits_page")
