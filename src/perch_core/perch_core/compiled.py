"""C source as a shared library, compiled once per machine and kept in a cache.

The cache is `$PERCH_CACHE` or `~/.cache/perch`. A library's name is the hash of its source, the compiler, its flags and the
processor: a change of any of them yields a new library. It is written under a temporary name and then renamed, so that
several processes may compile it at once. Without a compiler, or with PERCH_COMPILE=0, there is no library; callers fall back.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

from perch_core.errors import PerchError

FLAGS = ("-O2", "-march=native", "-ffp-contract=off", "-fPIC", "-shared")


def cache_folder() -> Path:
    """Return the folder in which compiled libraries are cached."""
    return Path(os.environ.get("PERCH_CACHE") or Path.home() / ".cache" / "perch")


@lru_cache(maxsize=1)
def compiler() -> tuple[str, str] | None:
    """Return path and version of the C compiler ($CC, gcc, cc or clang), or None."""
    for name in (os.environ.get("CC"), "gcc", "cc", "clang"):
        path = shutil.which(name) if name else None
        if path:
            answer = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
            if answer.returncode == 0:
                return path, answer.stdout.splitlines()[0]
    return None


def _processor() -> str:
    """Return the processor features that -march=native uses: a cache on a shared disk must not serve another processor."""
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as info:
            return next((line for line in info if line.startswith(("flags", "Features"))), "")
    except OSError:
        return ""


def library(name: str, source: str, flags: tuple[str, ...] = FLAGS) -> Path | None:
    """Compile C source, or return the cached library.

    Args:
        name: prefix of the file name, for readers.
        source: C code.
        flags: compiler flags.

    Returns:
        The shared library, or None without a compiler or with PERCH_COMPILE=0.

    Raises:
        PerchError: the cache cannot be written.
        RuntimeError: the compiler failed; its first lines are in the message.
    """
    found = None if os.environ.get("PERCH_COMPILE") == "0" else compiler()
    if found is None:
        return None
    key = "\n".join((source, *found, *flags, platform.machine(), _processor()))
    product = cache_folder() / f"{name}_{hashlib.sha256(key.encode()).hexdigest()[:24]}.so"
    if product.is_file():
        return product
    try:
        product.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=product.parent) as folder:
            code, object_file = Path(folder, "code.c"), Path(folder, "code.so")
            code.write_text(source)
            answer = subprocess.run([found[0], *flags, str(code), "-o", str(object_file), "-lm"],
                                    capture_output=True, text=True, check=False)
            if answer.returncode:
                raise RuntimeError(f"{found[0]} cannot compile {name}: {answer.stderr[:500]}")
            os.replace(object_file, product)
    except OSError as error:
        raise PerchError(f"the cache of compiled code cannot be written: {error}; set PERCH_CACHE to a folder that can be, or "
                         "PERCH_COMPILE to 0") from error
    return product
