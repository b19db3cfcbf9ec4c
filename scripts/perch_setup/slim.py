"""Takes away what wheels bring and nobody uses."""

from __future__ import annotations

import filecmp
import os
import shutil
from itertools import groupby
from pathlib import Path

_UNUSED = ("casadi/include", "casadi/*.a", *(f"{name}/**/tests" for name in ("dask", "matplotlib", "numba", "numpy", "pandas", "scipy")))
"""Headers and libraries to link with, and the libraries' own tests."""


def slim(packages: Path) -> None:
    """Make a `site-packages` smaller. Repeating it changes nothing."""
    for path in [path for pattern in _UNUSED for path in packages.glob(pattern)]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    link_copies(packages / "casadi")


def link_copies(folder: Path, pattern: str = "*.so*") -> int:
    """Replace equal files of a folder by links to one of them: a wheel cannot hold links, it has a library once for each of its names.

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
