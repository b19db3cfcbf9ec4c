"""Names in a registry to the classes behind them."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def resolved(place: str) -> Any:
    """What stands at `module:name`; the module is imported when it is asked for."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)
