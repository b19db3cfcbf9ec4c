#!/usr/bin/env python3
"""Write docs/equations.md: where each equation of both papers stands in the code."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.equations")
