"""Makes the virtual environment `<repository>/.venv` and installs the locked packages."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path
from typing import Callable, Mapping, Optional, Sequence

from .layout import EXTRAS, STATE, VENV, VENV_PYTHON
from .machine import Platform
from .progress import Step
from .slim import slim
from .wheel_paths import repair_wheels

_UNFINISHED = STATE / "installing"
"""Marker file that exists until pip is done. A killed venv leaves a Python without pip, a killed pip leaves broken packages."""
_USER_SETTINGS = ("PIP_TARGET", "PIP_PREFIX", "PIP_REQUIRE_VIRTUALENV", "PYTHONHOME", "PYTHONSTARTUP")


def install(target: Platform, fresh: bool) -> None:
    """Install the locked versions into the virtual environment.

    Args:
        target: where ROS comes from, and the lock files.
        fresh: start from an empty environment, as for another source of ROS or a moved checkout.

    Raises:
        SetupError: a tool fails.
    """
    environment = _environment(target)
    STATE.mkdir(exist_ok=True)
    fresh = fresh or not usable()
    if fresh:
        _UNFINISHED.touch()
        with Step("virtual environment") as step:
            shutil.rmtree(VENV, ignore_errors=True)
            access = [] if target.uses_wheels else ["--system-site-packages"]
            outside = getattr(sys, "_base_executable", "") or sys.executable  # of any virtual environment: ours has just been removed
            step.run([outside, "-m", "venv", *access, VENV], "venv", environment)
    total = sum(_pins(lock.read_text()) for lock in target.locks)
    with Step(f"installing {total} packages") as step:
        _pip(step, environment, total, *target.locks, on_change=_UNFINISHED.touch)
        if target.uses_wheels:
            repair_wheels(VENV)
    _UNFINISHED.unlink(missing_ok=True)  # where all packages were there, pip has changed nothing


def install_extra(target: Platform, extra: str) -> None:
    """Install the packages of an extra into the virtual environment.

    Raises:
        SetupError: pip fails, as it does without network.
    """
    unfinished = STATE / f"installing_{extra}"
    again = ["--ignore-installed"] if unfinished.exists() else []  # a killed pip leaves packages that are none
    unfinished.touch()
    total = _pins(EXTRAS[extra].read_text())
    with Step(f"installing {total} extra package{'s' * (total != 1)} ({extra})") as step:
        _pip(step, _environment(target), total, EXTRAS[extra], options=again)
    unfinished.unlink()


def _pip(step: Step, environment: Mapping[str, str], total: int, *locks: Path, options: Sequence[str] = (),
         on_change: Callable[[], object] = lambda: None) -> None:
    """Install the `total` packages of lock files, without their unused files. `on_change` is called before the first change.

    The locks are complete, so pip has nothing to resolve; tests check that they fit together.
    """
    pip = [VENV_PYTHON, "-m", "pip", "install", "--no-deps", "--no-compile", "--progress-bar", "off", "--no-input"]
    quiet = ["--disable-pip-version-check", "--no-warn-script-location"]
    step.run([*pip, *quiet, *options, *(word for lock in locks for word in ("-r", str(lock)))], "pip", environment, _progress_parser(total, on_change))
    for packages in VENV.glob("lib/python3.*/site-packages"):
        slim(packages)


def usable() -> bool:
    """Return whether there is a completed environment whose Python still has the version for which the packages were installed.

    venv writes `activate` last; its `python3` is a link, whose target an upgrade of the system can change.
    """
    if not VENV_PYTHON.exists() or not (VENV_PYTHON.parent / "activate").exists() or _UNFINISHED.exists():
        return False
    target = VENV_PYTHON.resolve().name
    return re.fullmatch(r"python3\.\d+", target) is None or (VENV / "lib" / target).exists()


def _environment(target: Platform) -> dict[str, str]:
    """Return the caller's environment without variables that interfere with pip, whose output is read."""
    environment = {key: value for key, value in os.environ.items() if key not in _USER_SETTINGS}
    environment.update(PIP_USER="0", PIP_QUIET="0", PYTHONNOUSERSITE="1")
    if target.uses_wheels:
        environment.pop("PYTHONPATH", None)
        environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return environment


def _pins(lock: str) -> int:
    """Return the number of packages in a lock file."""
    return len(re.findall(r"^[a-zA-Z0-9]", lock, re.MULTILINE))


def _progress_parser(total: int, on_change: Callable[[], object]) -> Callable[[str], Optional[str]]:
    """Return a function that turns pip's lines into a count; pip has fetched all packages before it changes any."""
    count = 0

    def describe(line: str) -> Optional[str]:
        nonlocal count
        if line.startswith(("Collecting ", "Requirement already satisfied")):
            count += 1
            return f"{min(count, total)}/{total}"
        if line.startswith("Installing collected"):
            on_change()
            return "unpacking"
        return None

    return describe
