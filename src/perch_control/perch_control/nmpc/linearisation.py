"""Evaluation of the stage function at all nodes at once: compiled C in a loop, or interpreted CasADi without a compiler."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np

from perch_control.nmpc.model import INPUTS, StageLayout, stage
from perch_core import compiled
from perch_core.vehicle import Vehicle

_LOOP = """
int all_stages(const double* z, double** o, int n) {{
  for (int k = 0; k < n; ++k) {{
    const double* arg[1] = {{z + k * {arguments}}};
    double* res[5] = {{o[0] + k * {n}, o[1] + k * {n} * {n}, o[2] + k * {n} * {inputs}, o[3] + k * {n} * {n}, o[4] + k * {n}}};
    {name}(arg, res, 0, 0, 0);
  }}
  return 0;
}}
"""


class Linearisation:
    """Evaluates the stage function at every node.

    Attributes:
        compiled: whether C code runs.
        arguments: filled by the caller, shape (nodes, layout.arguments).
        stages: results of the last `evaluate`: next states (nodes, n), A and B by columns (nodes, n, n), (nodes, 4, n) - so the
            arrays hold their transposes -, Q (nodes, n, n), q (nodes, n).
    """

    def __init__(self, vehicle: Vehicle, step: float, layout: StageLayout, nodes: int) -> None:
        function, n = stage(vehicle, step, layout), layout.states
        generator = ca.CodeGenerator("stages.c")
        generator.add(function)
        loop = _LOOP.format(name=function.name(), arguments=layout.arguments, n=n, inputs=INPUTS)
        path = compiled.library(f"nmpc_{function.name()}", generator.dump() + loop)
        self.compiled = path is not None
        self.arguments = np.zeros((nodes, layout.arguments))
        self.stages = tuple(np.zeros((nodes, *shape)) for shape in ((n,), (n, n), (INPUTS, n), (n, n), (n,)))
        if path is not None:
            code = ctypes.CDLL(str(path)).all_stages
            code.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
            z, o = self.arguments.ctypes.data, (ctypes.c_void_p * 5)(*(array.ctypes.data for array in self.stages))
            self._evaluate = lambda: code(z, o, nodes)
        else:
            self._map = function.map(nodes)
            self._evaluate = self._interpret

    def _interpret(self) -> None:
        for array, result in zip(self.stages, self._map(self.arguments.T), strict=True):
            array[:] = np.asarray(result).T.reshape(array.shape)

    def evaluate(self) -> tuple[np.ndarray, ...]:
        """Evaluate and return `stages` at the present arguments."""
        self._evaluate()
        return self.stages
