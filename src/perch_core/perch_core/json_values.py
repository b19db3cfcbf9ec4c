"""What JSON can hold, and files of it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def finite(value: Any) -> Any:
    """The same without nan and infinities, which JSON has not: null means that a figure is not available."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_text(value: Any) -> str:
    """As the text of a file for readers, `finite`."""
    return json.dumps(finite(value), indent=1) + "\n"


def write_json(file: Path, value: Any) -> None:
    """Write `to_text`."""
    file.write_text(to_text(value))
