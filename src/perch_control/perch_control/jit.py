"""Compilation of scalar code with numba where it is installed; the very same source in plain Python where it is not."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable

try:
    from numba import njit
except ImportError:  # the functions are written on floats and tuples, so that plain Python runs them too
    njit = None

COMPILED = njit is not None


@lru_cache(maxsize=1)
def _sources() -> str:
    """Hash of every file of this package that holds compiled functions."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        text = path.read_bytes()
        if b"@scalar" in text:
            digest.update(text)
    return digest.hexdigest()


def scalar(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of floats and tuples of floats; cached on disk beside its source.

    The plain function stays reachable as `.py_func` with and without numba.
    """
    if njit is None:
        function.py_func = function
        return function
    compiled = njit(cache=True, error_model="numpy")(function)
    # numba's cache looks at the function's own file alone: a change in a function that it calls in another file would
    # go unseen. The stamp of the whole package's compiled sources takes the place of that file's date.
    index = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if hasattr(index, "_source_stamp"):
        index._source_stamp = _sources()
    return compiled
