"""Ruff finds nothing: settings in ruff.toml, version in requirements/."""

from __future__ import annotations

import subprocess
import sys

from perch_setup.layout import ROOT


def test_ruff_finds_nothing():
    done = subprocess.run([sys.executable, "-m", "ruff", "check", "--no-cache", "--output-format=concise", "."], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
