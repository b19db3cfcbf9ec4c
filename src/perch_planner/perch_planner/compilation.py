"""Kernels are written once: numba compiles them where it is installed, the interpreter runs them where it is not.

Compiled code is cached beside the source, so that only the first process of a checkout pays for it. The variable
PERCH_NUMBA=0 turns compilation off; the results agree to rounding, a plan then takes about a hundred times longer.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

Kernel = TypeVar("Kernel", bound=Callable)

try:
    if os.environ.get("PERCH_NUMBA") == "0":
        raise ImportError
    import numba
except ImportError:
    numba = None

COMPILED = numba is not None


def compiled(kernel: Kernel) -> Kernel:
    """Decorator: the kernel compiled by numba with an on-disk cache, or the kernel itself."""
    return numba.njit(cache=True, error_model="numpy")(kernel) if COMPILED else kernel
