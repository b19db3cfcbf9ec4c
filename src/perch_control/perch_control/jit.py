"""Compilation of scalar code with numba where it is installed; the very same source in plain Python where it is not."""

from __future__ import annotations

from typing import Any, Callable

try:
    from numba import njit
except ImportError:  # the functions are written on floats and tuples, so that plain Python runs them too
    njit = None

COMPILED = njit is not None


def scalar(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of floats and tuples of floats; cached on disk beside its source.

    The plain function stays reachable as `.py_func` with and without numba.
    """
    if njit is None:
        function.py_func = function
        return function
    return njit(cache=True, error_model="numpy")(function)
