#!/usr/bin/env python3
"""Betaflight as a program on this machine: build it, print its path, or configure an autopilot. `--help` shows the options."""

from perch_setup import run

if __name__ == "__main__":
    run("perch_autopilot.command")
