"""Kernels cost a process little where they are not called or compiled already, and the compiler is there for the others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from perch_core.jit import COMPILED

pytestmark = pytest.mark.skipif(not COMPILED, reason="without numba nothing is compiled")

KERNELS = """
import math

import numpy as np

from perch_core.jit import compiled

@compiled
def norm(x: np.ndarray) -> float:
    total = 0.0
    for value in x:
        total += value * value
    return math.sqrt(total)

@compiled
def unit(x: np.ndarray) -> np.ndarray:
    return x / norm(x)
"""
CALLS = """
import pickle
import sys

import numpy as np
import kernels

from perch_core.jit import uncompiled

x = np.array([3.0, 0.0, -4.0])
with uncompiled():
    assert kernels.unit(x).tolist() == [0.6, 0.0, -0.8]
assert "numba" not in sys.modules and pickle.loads(pickle.dumps(kernels.norm)) is kernels.norm
norm, compiler = kernels.norm(x), "numba.typed.typeddict" in sys.modules
print(norm, compiler, "coverage" in sys.modules, *[float(value) for value in kernels.unit(x)], sum(kernels.norm.dispatcher.stats.cache_hits.values()))
"""


def test_numba_comes_with_the_first_call_and_what_is_compiled_is_loaded_without_the_compiler_which_then_compiles_what_calls_it(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}

    def called() -> list[str]:
        return subprocess.run([sys.executable, "-c", CALLS], env=environment, capture_output=True, text=True, check=True).stdout.split()

    assert called() == ["5.0", "True", "False", "0.6", "0.0", "-0.8", "0"]  # compiled by the first process
    for left in (tmp_path / "__pycache__").glob("kernels.unit*"):
        left.unlink()
    assert called() == ["5.0", "False", "False", "0.6", "0.0", "-0.8", "1"]
    ahead = "import kernels; from perch_core.jit import load_cached; load_cached('kernels'); print(len(kernels.unit.dispatcher.overloads))"
    assert subprocess.run([sys.executable, "-c", ahead], env=environment, capture_output=True, text=True, check=True).stdout == "1\n"


SCALED = """
import numpy as np

from perch_core.jit import compiled

SCALE, TABLE = {scale}, (np.array([1.0, {entry}]), 2.0)

@compiled
def scaled(x: float) -> float:
    return SCALE * x

@compiled
def summed(x: float) -> float:
    return scaled(x) + TABLE[0][1]
"""


def test_compiled_code_is_replaced_where_a_constant_of_a_kernel_that_it_calls_has_changed() -> None:
    def constants(scale: float, entry: float) -> str:
        module: dict = {}
        exec(SCALED.format(scale=scale, entry=entry), module)
        return module["summed"].constants

    assert constants(9.81, 3.0) == constants(9.81, 3.0)
    assert len({constants(9.81, 3.0), constants(3.7, 3.0), constants(9.81, 3.0 + 1e-15)}) == 3
