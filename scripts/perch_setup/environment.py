"""The environment variables in which nodes, tests and tools of perch run."""

from __future__ import annotations

import os
import subprocess

from .errors import FAILED, SetupError
from .layout import SETUP_BASH
from .machine import Platform

DOMAIN_MAX = 232  # its ports are the last ones
_OURS = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "PYTHONPATH", "PYTHONHOME")


def variables(target: Platform, with_workspace: bool = True) -> dict[str, str]:
    """Return the variables of `source setup.bash`, on top of the caller's variables.

    Args:
        target: where ROS comes from. With our wheels, leftovers of other workspaces are dropped;
            with an installation they belong to it and are kept.
        with_workspace: whether the built packages are part of it.

    Raises:
        SetupError: sourcing fails, or ROS_DOMAIN_ID is no domain.
    """
    start = {key: value for key, value in os.environ.items() if not (target.uses_wheels and key in _OURS)}
    start["PERCH_WITHOUT_WORKSPACE"] = "" if with_workspace else "1"
    script = 'source "$1" >&2 && exec env -0'
    answer = subprocess.run(["bash", "--norc", "-c", script, "bash", SETUP_BASH], env=start, capture_output=True)
    if answer.returncode:
        reason = answer.stderr.decode(errors="replace").strip()
        raise SetupError(f"sourcing {SETUP_BASH} failed: {reason}", FAILED)
    pairs = (entry.partition("=") for entry in answer.stdout.decode(errors="surrogateescape").split("\0"))
    result = {key: value for key, _, value in pairs if key}
    for temporary in ("PERCH_WITHOUT_WORKSPACE", "_", "SHLVL", "OLDPWD"):
        result.pop(temporary, None)
    domain = result["ROS_DOMAIN_ID"]
    if not (domain.isdecimal() and int(domain) <= DOMAIN_MAX):
        raise SetupError(f"ROS_DOMAIN_ID={domain} is not a number from 0 to {DOMAIN_MAX}")
    return result
