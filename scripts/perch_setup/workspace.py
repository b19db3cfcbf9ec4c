"""Builds the colcon workspace into `<repository>/install`."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Iterable, Optional

from .environment import variables
from .layout import BUILD, INSTALL, ROOT, SOURCES, STATE, VENV, VENV_PYTHON
from .machine import Platform
from .progress import Step

_COLCON = "import sys; from colcon_core.command import main; sys.exit(main())"
"""Colcon is started by our Python, so that the executables that it writes run in our Python as well."""


def build(selected: Iterable[Path], target: Platform, fresh: bool) -> None:
    """Build packages with links to their sources, so that edits of Python files are live.

    Args:
        selected: folders of the packages to build.
        target: where ROS comes from.
        fresh: remove everything that was built before.

    Raises:
        SetupError: a package does not build; the message has the last lines of the compiler.
    """
    names = sorted(folder.name for folder in selected)
    # Each from an empty folder: what a killed build left is not sound, nor is typesupport that was linked with a message that has gone.
    for folder in (BUILD, INSTALL) if fresh else [base / name for base in (BUILD, INSTALL) for name in names]:
        shutil.rmtree(folder, ignore_errors=True)
    with Step(f"building {len(names)} package{'s' * (len(names) != 1)}") as step:
        command = [
            *(VENV_PYTHON, "-c", _COLCON, "--log-base", STATE / "log" / "colcon", "build"),
            *("--base-paths", SOURCES, "--build-base", BUILD, "--install-base", INSTALL),
            *("--symlink-install", "--event-handlers", "console_direct+", "desktop_notification-"),
            *("--packages-select", *names),
            *("--cmake-args", "-DCMAKE_BUILD_TYPE=Release", "--no-warn-unused-cli"),
        ]
        step.run(command, "build", _environment(target), _progress)


def _environment(target: Platform) -> dict[str, str]:
    """Return the environment variables for colcon, CMake and the generators."""
    environment = variables(target, with_workspace=False)
    environment["PYTHONNOUSERSITE"] = "1"
    environment["PWD"] = str(ROOT)
    # CMake asks for `python3` in several ways; all of them end at ours.
    environment["VIRTUAL_ENV"] = str(VENV)
    return environment


def _progress(line: str) -> Optional[str]:
    """Return the progress in a line of colcon: the name of a package that begins, or make's percentage of a message package."""
    started = re.match(r"Starting >>> (\S+)", line)
    percentage = re.match(r"\[ *(\d+)%\] .*?\b(\w+?_msgs)", line)  # several packages are built at the same time
    if started:
        return started.group(1)
    return f"{percentage.group(2)} {percentage.group(1)} %" if percentage else None
