"""Stage functions as machine code, compiled once per machine and kept in a cache.

The cache is `$PERCH_CACHE` or `~/.cache/perch`. A library's name is the hash of its C source, the compiler and its flags,
so that a change of the model, of CasADi or of the compiler makes a new one. It is written under a temporary name and
renamed, so that two processes may do it at once. Without a compiler, or with PERCH_COMPILE=0, the functions stay
interpreted: about five times slower, the same results.
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

import casadi as ca

from perch_planner.powerline.stage_functions import StageFunctions

# -O1 halves the compile time of -O3 for straight-line code of this kind, and the code runs as fast.
FLAGS = ("-O1", "-march=native", "-ffp-contract=off", "-fPIC", "-shared")


def cache_folder() -> Path:
    """Where compiled functions are kept."""
    return Path(os.environ.get("PERCH_CACHE") or Path.home() / ".cache" / "perch")


@lru_cache(maxsize=1)
def compiler() -> tuple[str, str] | None:
    """Path and version of the C compiler ($CC, gcc, cc or clang), or None."""
    for name in (os.environ.get("CC"), "gcc", "cc", "clang"):
        path = shutil.which(name) if name else None
        if path:
            answer = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
            if answer.returncode == 0:
                return path, answer.stdout.splitlines()[0]
    return None


def _source(functions: dict[str, ca.Function]) -> str:
    """C code of the functions, and of the adjoint of those that are differentiated further (see `is_diff_in`)."""
    generator = ca.CodeGenerator("stages.c")
    for name, function in functions.items():
        generator.add(function)
        if f"{name}_jac" in functions:
            generator.add(function.reverse(1))
    return generator.dump()


def build(functions: dict[str, ca.Function]) -> Path | None:
    """Compile functions, or find them compiled.

    Returns:
        The shared library, or None where there is no compiler or it is not wanted.

    Raises:
        RuntimeError: the compiler failed; its first lines are in the message.
    """
    found = None if os.environ.get("PERCH_COMPILE") == "0" else compiler()
    if found is None:
        return None
    source = _source(functions)
    key = "\n".join((source, *found, *FLAGS, platform.processor(), platform.machine(), _cpu_flags()))
    library = cache_folder() / f"stages_{hashlib.sha256(key.encode()).hexdigest()[:24]}.so"
    if library.is_file():
        return library
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        code, product = Path(folder, "stages.c"), Path(folder, "stages.so")
        code.write_text(source)
        answer = subprocess.run([found[0], *FLAGS, str(code), "-o", str(product), "-lm"],
                                capture_output=True, text=True, check=False)
        if answer.returncode:
            raise RuntimeError(f"{found[0]} cannot compile the stage functions: {answer.stderr[:500]}")
        os.replace(product, library)
    return library


def _cpu_flags() -> str:
    """What -march=native depends on: a cache on a shared disk must not serve another processor."""
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as info:
            return next((line for line in info if line.startswith(("flags", "Features"))), "")
    except OSError:
        return ""


def load(stages: StageFunctions) -> tuple[StageFunctions, bool]:
    """Stage functions with compiled bodies, or as they are where there is no compiler.

    Returns:
        The functions, and whether they are compiled.
    """
    library = build(stages.functions)
    if library is None:
        return stages, False
    return stages.with_functions({
        name: ca.external(name, str(library), {"is_diff_in": [function.is_diff_in(i) for i in range(function.n_in())]})
        for name, function in stages.functions.items()
    }), True
