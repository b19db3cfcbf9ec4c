"""Optional packages, which set-up installs only on request (`requirements/extras`)."""

from __future__ import annotations

from importlib.util import find_spec

from perch_core.errors import PerchError

MODULES = {"campaigns": ("distributed",), "recordings": ("evo", "rosbags"), "view": ("foxglove",)}


def require(extra: str) -> None:
    """Check that the packages of an extra are installed.

    Raises:
        PerchError: a package is missing; the message has the command that installs it.
    """
    missing = [module for module in MODULES[extra] if find_spec(module) is None]
    if missing:
        raise PerchError(f"{' and '.join(missing)} {'are' if len(missing) > 1 else 'is'} not installed: python3 scripts/setup.py --extra {extra}")
