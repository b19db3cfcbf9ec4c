"""Stage functions for all nodes at once: compiled C in a loop, or interpreted CasADi where there is no compiler."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np

from perch_control.nmpc.model import StageLayout, stage
from perch_core import compiled
from perch_core.vehicle import Vehicle

_LOOP = """
int all_stages(const double* z, double* o, int n) {{
  for (int k = 0; k < n; ++k) {{
    const double* arg[1] = {{z + k * {arguments}}};
    double* res[1] = {{o + k * {results}}};
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
        results: of the last `evaluate`, shape (nodes, layout.results).
    """

    def __init__(self, vehicle: Vehicle, step: float, layout: StageLayout, nodes: int) -> None:
        function = stage(vehicle, step, layout)
        generator = ca.CodeGenerator("stages.c")
        generator.add(function)
        loop = _LOOP.format(name=function.name(), arguments=layout.arguments, results=layout.results)
        path = compiled.library(f"nmpc_{function.name()}", generator.dump() + loop)
        self.compiled = path is not None
        self.arguments = np.zeros((nodes, layout.arguments))
        self.results = np.zeros((nodes, layout.results))
        if path is not None:
            code = ctypes.CDLL(str(path)).all_stages
            code.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
            z, o = self.arguments.ctypes.data, self.results.ctypes.data
            self._evaluate = lambda: code(z, o, nodes)
        else:
            self._map = function.map(nodes)
            self._evaluate = self._interpret

    def _interpret(self) -> None:
        self.results[:] = np.asarray(self._map(self.arguments.T)).T

    def evaluate(self) -> np.ndarray:
        """Results at the present arguments, shape (nodes, layout.results)."""
        self._evaluate()
        return self.results
