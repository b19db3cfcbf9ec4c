"""Makes one file of several equal ones: a wheel cannot hold links, so it has a library once for each of its names."""

from __future__ import annotations

import filecmp
import os
from itertools import groupby
from pathlib import Path


def link_copies(folder: Path, pattern: str = "*.so*") -> int:
    """Replace equal files of a folder by links to one of them. Repeating it changes nothing.

    A file system that knows no links keeps the copies.

    Returns:
        Bytes that are free again.
    """
    def size(file: Path) -> int:
        return file.stat().st_size

    saved = 0
    files = sorted((file for file in folder.glob(pattern) if file.is_file() and not file.is_symlink()), key=lambda file: (size(file), file.name))
    for _, same in groupby(files, size):
        kept: list[Path] = []
        for file in same:
            other = next((other for other in kept if filecmp.cmp(file, other, shallow=False)), None)
            if other is None:
                kept.append(file)
            elif not file.samefile(other):
                draft = file.with_name(f"{file.name}.link")
                try:
                    os.link(other, draft)
                except OSError:
                    return saved
                saved += size(file)
                draft.replace(file)
    return saved
