"""Stage functions as machine code, from the machine's cache of compiled libraries (`perch_core.compiled`)."""

from __future__ import annotations

import casadi as ca

from perch_core import compiled
from perch_planner.powerline.stage_functions import StageFunctions

# -O1 halves the compile time of -O2 for straight-line code of this kind, and the code runs as fast.
FLAGS = ("-O1", "-march=native", "-ffp-contract=off", "-fPIC", "-shared")


def _source(functions: dict[str, ca.Function]) -> str:
    """C code of the functions, and of the adjoint of those that are differentiated further (see `is_diff_in`)."""
    generator = ca.CodeGenerator("stages.c")
    for name, function in functions.items():
        generator.add(function)
        if f"{name}_jac" in functions:
            generator.add(function.reverse(1))
    return generator.dump()


def load(stages: StageFunctions) -> tuple[StageFunctions, bool]:
    """Stage functions with compiled bodies, or unchanged where there is no compiler or PERCH_COMPILE is 0.

    Interpreted they are about five times slower, with the same results.

    Returns:
        The functions, and whether they are compiled.

    Raises:
        PerchError, RuntimeError: as `perch_core.compiled.library`.
    """
    library = compiled.library("powerline", _source(stages.functions), FLAGS)
    if library is None:
        return stages, False
    return stages.with_functions({
        name: ca.external(name, str(library), {"is_diff_in": [function.is_diff_in(i) for i in range(function.n_in())]})
        for name, function in stages.functions.items()
    }), True
