"""Compilation of the plant's scalar kernels: numba where it is installed, the same source in plain Python where it is not."""

from __future__ import annotations

from typing import Any, Callable

try:
    from numba import njit
except ImportError:  # slower (about 0.2 ms per step), the same flight
    njit = None


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a kernel, cached beside its source.

    Without `fastmath`: results must not depend on how the compiler groups a sum. Kernels that call each other live
    in one file, as numba's cache does not see a change in another one.
    """
    return function if njit is None else njit(cache=True, error_model="numpy")(function)
