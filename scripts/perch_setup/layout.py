"""Where everything lies in the repository."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VENV = ROOT / ".venv"
STATE = ROOT / ".perch"
"""What set-up remembers: stamps, its lock file and its logs."""
ROS_PREFIX = STATE / "ros_prefix"
"""Holds the prefix of the ROS installation that the workspace was built with, if it was."""
SOURCES = ROOT / "src"
BUILD = ROOT / "build"
INSTALL = ROOT / "install"
REQUIREMENTS = ROOT / "requirements"
EXTRAS = {lock.stem: lock for lock in sorted((REQUIREMENTS / "extras").glob("*.lock"))}
"""Packages that a flight does without: name -> lock file. The script that needs them has them installed."""
SETUP_BASH = ROOT / "setup.bash"
VENV_PYTHON = VENV / "bin" / "python"
