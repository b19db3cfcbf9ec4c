"""Removal of unused files of installed wheels."""

from __future__ import annotations

import filecmp
import os
import shutil
import subprocess
from itertools import groupby
from pathlib import Path

_UNUSED = (
    *(f"{name}/**/tests" for name in ("dask", "matplotlib", "numba", "numpy", "pandas", "scipy")),
    *(f"casadi/{name}" for name in ("include", "*.a", "liblacemodelica*", "libcasadi_graphmodel_onnx*", "libantlr4*")),
    *(f"casadi/lib*{name}*" for name in ("highs", "alpaqa", "uno", "Clp", "Cbc", "Cgl", "Osi", "CoinUtils", "bonmin")),
)
"""The libraries' own tests; CasADi's headers, importers and solvers, except small ones and those in use (fatrop, ipopt)."""
_WITH_SYMBOLS = ("llvmlite/**", "zstandard", "fontTools/**", "kiwisolver", "lz4/**", "yaml", ".")
"""Folders whose libraries were published with debug symbols. Wheels that bundle further libraries are left out, as `strip`
may damage libraries that were patched for bundling."""


def slim(packages: Path) -> None:
    """Reduce the size of a `site-packages` by a third. Idempotent."""
    for path in [path for pattern in _UNUSED for path in packages.glob(pattern)]:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    link_copies(packages, "**/*.so*")
    for pattern in _WITH_SYMBOLS:
        for library in packages.glob(f"{pattern}/*.so"):
            strip(library)


def strip(library: Path) -> None:
    """Remove the debug symbols of a library, which may be in use."""
    draft = library.with_name(f"{library.name}.stripped")
    done = subprocess.run(["strip", "--strip-unneeded", "-o", draft, library], stderr=subprocess.DEVNULL, check=False).returncode == 0
    if done and draft.stat().st_size < library.stat().st_size:
        draft.chmod(library.stat().st_mode)
        draft.replace(library)
    else:
        draft.unlink(missing_ok=True)


def link_copies(folder: Path, pattern: str = "*.so*") -> int:
    """Replace equal files below a folder by hard links to one of them, as wheels can neither hold links nor share a library.

    On a file system without hard links the copies are kept.

    Returns:
        Number of bytes saved.
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
