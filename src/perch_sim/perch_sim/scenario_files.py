"""Scenario files, which may build on each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from perch_core.extends import extended_mapping


def scenario_mapping(name_or_path: str | Path) -> dict[str, Any]:
    """What a scenario (a name in `config/scenarios`, or a file) says with all that it extends; see `extended_mapping`."""
    return extended_mapping("scenarios", name_or_path)
