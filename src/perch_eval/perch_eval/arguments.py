"""What commands take: counts, and folders for results, which are tried out before the work begins."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from perch_core.errors import ConfigError


def count(text: str) -> int:
    """How many, at least one, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not >= 1")
    return value


def output_folder(path: Path, option: str = "--out") -> Path:
    """Make a folder for results.

    Args:
        path: of the folder.
        option: what the caller named it with, for the message.

    Raises:
        ConfigError: it cannot be made, or nothing can be written to it.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except OSError as error:
        raise ConfigError(option, str(path), f"cannot be written: {error.strerror}") from None
