"""Kernels are written once: numba compiles them where it is installed, the interpreter runs them where it is not.

Compiled code is cached beside its source, so that only the first process of a checkout pays for it. PERCH_NUMBA=0 turns
compilation off: the same results to rounding, many times slower.

Two habits of numba cost each process more than its kernels, and are kept from it: it imports `coverage` where that is installed (a
tenth of a second), and it registers all that it can compile before it loads the first compiled kernel (half a second).
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast, overload

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

njit: Any = None
_absent = [name for name in ("coverage",) if name not in sys.modules]  # where nobody measures it, `import coverage` fails meanwhile
try:
    if os.environ.get("PERCH_NUMBA") == "0":
        raise ImportError
    sys.modules.update(dict.fromkeys(_absent))  # type: ignore[arg-type]
    from numba import njit
except ImportError:
    pass
finally:
    for name in _absent:
        sys.modules.pop(name, None)

COMPILED = njit is not None


@lru_cache(maxsize=None)
def _stamp(package: Path) -> str:
    """Hash of every file with kernels in a package and in this one."""
    digest = hashlib.sha256()
    for folder in sorted({package, Path(__file__).parent}):
        for path in sorted(folder.rglob("*.py")):
            text = path.read_bytes()
            if b"@compiled" in text:
                digest.update(text)
    return digest.hexdigest()


def _package(file: Path) -> Path:
    """The outermost package that holds a file."""
    folder = file.parent
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


def _load(cache: Any, signature: Any, target: Any) -> Any:
    """A kernel's compiled code for a signature from its cache; None where there is none, and the compiler registers what it needs.

    In place of `numba.core.caching.Cache.load_overload`. What compiled code calls in numba's runtime has to be there.
    """
    from numba.core.runtime import rtsys

    rtsys.initialize(target)
    return cache._load_overload(signature, target)


@overload
def compiled(kernel: Kernel) -> Kernel: ...
@overload
def compiled(*, nogil: bool = False, inline: bool = False) -> Callable[[Kernel], Kernel]: ...
def compiled(kernel: Any = None, *, nogil: bool = False, inline: bool = False) -> Any:
    """Decorator: the kernel compiled by numba with an on-disk cache, or the kernel itself.

    With `nogil` it runs without the interpreter lock, which pays for kernels of milliseconds beside other threads. With `inline` it
    becomes a part of the kernels that call it: a loop over such calls, without branches, takes several elements at a time.

    Without `fastmath`: results must not depend on how a compiler groups a sum. The plain function stays reachable, see
    `interpreted`. A kernel may call kernels of its own package and of perch_core.
    """
    if kernel is None:
        return partial(compiled, nogil=nogil, inline=inline)
    if njit is None:
        kernel.py_func = kernel
        return kernel
    out = njit(cache=True, error_model="numpy", nogil=nogil, forceinline=inline)(kernel)
    # numba's cache looks at the kernel's own file alone: a change in a kernel that it calls in another file would go
    # unseen. The hash of all sources with kernels takes the place of that file's date.
    cache: Any = getattr(out, "_cache", None)
    if hasattr(getattr(cache, "_cache_file", None), "_source_stamp"):
        cache._cache_file._source_stamp = _stamp(_package(Path(kernel.__code__.co_filename)))
    if hasattr(cache, "_load_overload"):
        cache.load_overload = partial(_load, cache)
    return out


def interpreted(kernel: Kernel) -> Kernel:
    """The plain function of a kernel."""
    plain: Kernel = cast(Any, kernel).py_func
    return plain
