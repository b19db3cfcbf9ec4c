#!/usr/bin/env python3
"""Write docs/limits.md: limits on size, count, magnitude and rate of all inputs."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.limits_page")
