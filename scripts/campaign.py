#!/usr/bin/env python3
"""Fly many flights over drawn conditions and rank the causes of failure. `--help` shows the options."""

import sys

from perch_setup import run

if __name__ == "__main__":
    run("perch_eval.campaign.command", *["campaigns"] * any(word.startswith("--c") for word in sys.argv))  # argparse takes a part of --cluster, too
