"""Decorator for numerical kernels: numba compiles them where it is installed; otherwise they are interpreted.

Compiled code is cached beside its source, so that only the first process of a checkout compiles. PERCH_NUMBA=0 turns
compilation off: the same results to rounding, many times slower.

Three measures shorten numba's start. It is imported by the first call of a kernel, as most processes import kernels and call
none (0.3 s); it does not import `coverage` unless coverage is being measured (0.1 s); and loading compiled code does not
fill the compiler's registries (0.5 s).
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, lru_cache, partial, update_wrapper
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeVar, cast, overload

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

COMPILED = os.environ.get("PERCH_NUMBA") != "0" and find_spec("numba") is not None


@lru_cache(maxsize=None)
def _njit() -> Any:
    """Return numba's decorator, with `_Compiled` registered as a type that numba treats like its own dispatchers."""
    measured = "coverage" in sys.modules
    if not measured:
        sys.modules["coverage"] = cast(Any, None)  # numba goes on where this import fails
    try:
        from numba import njit
        from numba.core import types
        from numba.core.typing.typeof import typeof_impl
    finally:
        if not measured:
            del sys.modules["coverage"]
    typeof_impl.register(_Compiled)(lambda kernel, _: types.Dispatcher(kernel.dispatcher))
    return njit


@lru_cache(maxsize=None)
def _stamp(package: Path) -> str:
    """Return the hash of all files with kernels in a package and in this one."""
    digest = hashlib.sha256()
    for folder in sorted({package, Path(__file__).parent}):
        for path in sorted(folder.rglob("*.py")):
            text = path.read_bytes()
            if b"@compiled" in text:
                digest.update(text)
    return digest.hexdigest()


def _package(file: Path) -> Path:
    """Return the outermost package that contains a file."""
    folder = file.parent
    while (folder.parent / "__init__.py").exists():
        folder = folder.parent
    return folder


def _names(code: CodeType) -> set[str]:
    """Return the names that are read by a function and the functions within it."""
    return set(code.co_names).union(*(_names(inner) for inner in code.co_consts if isinstance(inner, CodeType)))


def _text(value: Any) -> str:
    """Return all digits of a constant: a number, an array, or a tuple of constants."""
    if isinstance(value, tuple):
        return f"({', '.join(map(_text, value))})"
    return f"{value.dtype} {value.shape} {value.tobytes().hex()}" if hasattr(value, "tobytes") else repr(value)


def _load(cache: Any, signature: Any, target: Any) -> Any:
    """Load a kernel's compiled code for a signature from its cache; None if it is not cached, in which case numba compiles it.

    Replaces `numba.core.caching.Cache.load_overload`; numba's runtime, which compiled code calls, must be initialised.
    """
    from numba.core.runtime import rtsys

    rtsys.initialize(target)
    return cache._load_overload(signature, target)


class _Compiled:
    """A kernel that numba compiles or loads when it is called. A call costs about 0.2 us more than that of a numba dispatcher.

    Attributes:
        py_func: the plain function.
    """

    plain = False  # what `uncompiled` switches, for all kernels
    kernels: list[_Compiled] = []  # of all imported modules

    def __init__(self, kernel: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func, self._options = kernel, options
        self.kernels.append(self)
        update_wrapper(self, kernel)

    @cached_property
    def constants(self) -> str:
        """Hash of the global values that are compiled into this kernel and into the kernels that it calls."""
        digest = hashlib.sha256()
        for name in sorted(_names(self.py_func.__code__)):
            value = self.py_func.__globals__.get(name)
            if isinstance(value, _Compiled):
                digest.update(b"" if value is self else value.constants.encode())
            elif not callable(value) and not isinstance(value, ModuleType):
                digest.update(f"{name} {_text(value)};".encode())
        return digest.hexdigest()

    @cached_property
    def dispatcher(self) -> Any:
        """numba's dispatcher of this kernel."""
        out = _njit()(cache=True, error_model="numpy", **self._options)(self.py_func)
        # numba's cache looks at the date of the kernel's own file alone: a change of a kernel that it calls in another file, or of a
        # constant from another file, would go unseen. The hashes of all sources with kernels and of these constants take its place.
        cache: Any = getattr(out, "_cache", None)
        if hasattr(getattr(cache, "_cache_file", None), "_source_stamp"):
            cache._cache_file._source_stamp = _stamp(_package(Path(self.py_func.__code__.co_filename))) + self.constants
        if hasattr(cache, "_load_overload"):
            cache.load_overload = partial(_load, cache)
        return out

    def load_cached(self) -> None:
        """Load the compiled code for all signatures in the cache."""
        cache: Any = getattr(getattr(self.dispatcher, "_cache", None), "_cache_file", None)
        for signature, *_ in cache._load_index() if hasattr(cache, "_load_index") else ():
            self.dispatcher.compile(signature)

    def __call__(self, *arguments: Any) -> Any:
        return self.py_func(*arguments) if self.plain else self.dispatcher(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__  # pickled as a function is


@overload
def compiled(kernel: Kernel) -> Kernel: ...
@overload
def compiled(*, nogil: bool = False, inline: bool = False) -> Callable[[Kernel], Kernel]: ...
def compiled(kernel: Any = None, *, nogil: bool = False, inline: bool = False) -> Any:
    """Decorate a kernel: numba compiles it with an on-disk cache; without numba it is returned unchanged.

    With `nogil` the kernel runs without the interpreter lock, which pays for kernels of milliseconds beside other threads. With
    `inline` it is inlined into the kernels that call it, so that loops over such calls without branches can be vectorised.

    `fastmath` is not used: results must not depend on how a compiler groups a sum. `interpreted` returns the plain function.
    A kernel may call kernels of its own package and of perch_core.
    """
    if kernel is None:
        return partial(compiled, nogil=nogil, inline=inline)
    if not COMPILED:
        kernel.py_func = kernel
        return kernel
    return _Compiled(kernel, {"nogil": nogil, "forceinline": inline})


def load_cached(*packages: str) -> None:
    """Load the cached code of all kernels in the imported modules of some packages: a first call would load it, in 5 to 20 ms."""
    for kernel in tuple(_Compiled.kernels):
        if (kernel.py_func.__module__ or "").partition(".")[0] in packages:  # code that is executed may have no module
            kernel.load_cached()


def interpreted(kernel: Kernel) -> Kernel:
    """Return the plain function of a kernel."""
    plain: Kernel = cast(Any, kernel).py_func
    return plain


@contextmanager
def uncompiled() -> Iterator[None]:
    """Interpret all kernels within this context, in all threads: for a few calls, importing numba takes longer than it saves."""
    _Compiled.plain = True
    try:
        yield
    finally:
        _Compiled.plain = False
