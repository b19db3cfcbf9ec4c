"""Conversion of values to JSON, and JSON files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from perch_core.files import replacement


def finite(value: Any) -> Any:
    """Replace nan and infinities, which JSON does not have, by None: null means that a figure is not available."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_text(value: Any) -> str:
    """Return a value as indented JSON text, with `finite` applied."""
    return json.dumps(finite(value), indent=1) + "\n"


def write_json(file: Path, value: Any) -> None:
    """Write a value to a file as `to_text` formats it; after an error or Ctrl-C, an earlier file is as before.

    Raises:
        OSError: the file cannot be written.
    """
    with replacement(file) as draft:
        draft.write_text(to_text(value))
