#!/usr/bin/env python3
"""Make sensor files from calibrations, and check recordings. `--help` shows the options."""

import sys

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.recordings.sensors_command", *["recordings"] * ("check" in sys.argv[1:]))
