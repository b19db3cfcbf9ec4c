"""Bars of perception: every `bench/perception_<part>.py` (tags, lines, VIO, UKF) in one group."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from harness import Figure

HERE = Path(__file__).resolve().parent


def figures(quick: bool) -> list[Figure]:
    """The figures of all parts, in the order of their names."""
    if str(HERE) not in sys.path:
        sys.path.insert(0, str(HERE))
    out: list[Figure] = []
    for path in sorted(HERE.glob("perception_*.py")):
        out += importlib.import_module(path.stem).figures(quick)
    return out
