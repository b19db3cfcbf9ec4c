"""Paths in the repository."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VENV = ROOT / ".venv"
STATE = ROOT / ".perch"
"""State of the set-up: stamps, lock file and logs."""
ROS_PREFIX = STATE / "ros_prefix"
"""File with the prefix of the ROS installation that the workspace was built with; absent with wheels."""
SOURCES = ROOT / "src"
BUILD = ROOT / "build"
INSTALL = ROOT / "install"
REQUIREMENTS = ROOT / "requirements"
EXTRAS = {lock.stem: lock for lock in sorted((REQUIREMENTS / "extras").glob("*.lock"))}
"""Optional packages, not needed for a flight: name -> lock file. Scripts that need them install them."""
SETUP_BASH = ROOT / "setup.bash"
VENV_PYTHON = VENV / "bin" / "python"
