"""Runs the repository's scripts as a user does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 120.0
"""Only ever waited for in full when a test fails [s]."""


def run_script(name: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Run `scripts/<name>` to its end."""
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / name), *arguments], env={**os.environ, **environment},
        capture_output=True, text=True, timeout=PATIENCE)


def start_script(name: str, *arguments: str, **environment: str) -> subprocess.Popen:
    """Start `scripts/<name>`; its output can be read."""
    return subprocess.Popen(
        [sys.executable, "-u", str(ROOT / "scripts" / name), *arguments], env={**os.environ, **environment},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
