"""Numba where it is installed, plain Python where it is not: the same source runs both ways."""

from __future__ import annotations

from typing import Callable, TypeVar

F = TypeVar("F", bound=Callable)

try:
    import numba
except ImportError:  # the suite flies without a compiler, only slower
    numba = None

COMPILED = numba is not None


def compiled(function: F) -> F:
    """Compile to machine code, cached beside the source; without numba the function is returned as it is.

    The Python source stays reachable as `.py_func` in both cases, for tests that compare them.
    """
    if numba is None:
        function.py_func = function
        return function
    return numba.njit(cache=True, error_model="numpy")(function)
