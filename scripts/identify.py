#!/usr/bin/env python3
"""Identify lags, gains, thrust and drag of a vehicle from a flight. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.identification.command")
