"""Kernels are written once: numba compiles them where it is installed, the interpreter runs them where it is not.

Compiled code is cached beside the source, so that only the first process of a checkout pays for it. The variable
PERCH_NUMBA=0 turns compilation off; the results agree to rounding, a plan then takes about a hundred times longer.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Kernel = TypeVar("Kernel", bound=Callable)

try:
    if os.environ.get("PERCH_NUMBA") == "0":
        raise ImportError
    import numba
except ImportError:
    numba = None

COMPILED = numba is not None


def _drop_stale_kernels(folder: Path) -> None:
    """Delete cached kernels that are older than any kernel's source.

    numba looks at the file of a kernel alone; a kernel that calls one in another file would keep its old copy of it.
    """
    sources = [path for path in folder.glob("*.py") if "@compiled" in path.read_text()]
    newest = max(path.stat().st_mtime for path in sources)
    for index in (folder / "__pycache__").glob("*.nbi"):
        if index.stat().st_mtime < newest:
            index.unlink(missing_ok=True)


if COMPILED:
    try:
        _drop_stale_kernels(Path(__file__).parent)
    except OSError:  # an installation that cannot be written to does not change either
        pass


def compiled(kernel: Kernel) -> Kernel:
    """Decorator: the kernel compiled by numba with an on-disk cache, or the kernel itself."""
    return numba.njit(cache=True, error_model="numpy")(kernel) if COMPILED else kernel
