"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacement(file: Path) -> Iterator[Path]:
    """Yield the path of a draft beside a file, which replaces it at the end; after an error or Ctrl-C, the file is as before.

    Raises:
        OSError: the file cannot be replaced.
    """
    draft = file.with_name(f".{os.getpid()}-{file.name}")
    try:
        yield draft
        draft.replace(file)
    finally:
        with suppress(OSError):
            draft.unlink()
