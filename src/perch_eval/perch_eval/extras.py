"""Packages that set-up leaves out until they are asked for (`requirements/extras`)."""

from __future__ import annotations

from importlib.util import find_spec

from perch_core.errors import PerchError

MODULES = {"campaigns": ("distributed",), "recordings": ("evo", "rosbags"), "view": ("foxglove",)}


def require(extra: str) -> None:
    """Refuse to go on without the packages of an extra.

    Raises:
        PerchError: with the command that installs them.
    """
    missing = [module for module in MODULES[extra] if find_spec(module) is None]
    if missing:
        raise PerchError(f"{' and '.join(missing)} {'are' if len(missing) > 1 else 'is'} not installed: python3 scripts/setup.py --extra {extra}")
