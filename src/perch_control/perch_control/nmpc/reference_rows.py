"""References of the shooting nodes: full states and rotor thrusts by flatness, each computed once.

The nodes are a whole number of control periods apart, so what is the last node now will be every other node later: in
steady flight one new row per period is enough.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_core.flatness import commanded_frame
from perch_core.jit import compiled
from perch_core.timing import CONTROL_PERIOD
from perch_core.vector3 import axpy, cross, dot, norm, quaternion_of, times
from perch_core.vehicle import GRAVITY

_KEPT = 4096


@compiled
def reference_row(x, floor, vehicle):
    """p, q, v, w and rotor thrusts of a setpoint, 17 floats. [M:eq9-13]

    A setpoint that carries its b3 keeps it, whatever is added to its acceleration on the way from one reference to another:
    where there is hardly any thrust, a small acceleration would be a large turn. The thrust is the force's part along it.

    Args:
        x: packed setpoint, 33 floats.
        floor: specific thrust below which the attitude is taken as level [m/s^2].
        vehicle: packed constants (see `packed_vehicle`).
    """
    f = (x[6], x[7], x[8] + GRAVITY)
    j, s = x[9:12], x[12:15]
    thrust = norm(f)
    if dot(x[24:27], x[24:27]) > 0.5:
        thrust = max(dot(f, x[24:27]), 0.0)
        f, j, s = x[24:27], x[27:30], x[30:33]
    elif thrust < floor:
        thrust = floor
        f, j, s = (0.0, 0.0, floor), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    h, dh, ddh = x[15:18], x[18:21], x[21:24]
    n = cross(h, f)
    if norm(n) < 1e-2 * norm(f):
        h, dh, ddh = cross(f, (1.0, 0.0, 0.0)), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        if norm(h) < 1e-2 * norm(f):
            h = cross(f, (0.0, 0.0, 1.0))
    b1, b2, b3, w, dw = commanded_frame(f, j, s, h, dh, ddh)
    q = quaternion_of(b1, b2, b3)
    J = vehicle[0][1:4]
    M = axpy(1.0, times(J, dw), cross(w, times(J, w)))
    T = vehicle[0][0] * thrust
    a, mx, my, d = vehicle[3]
    low, high = vehicle[1][0] * vehicle[1][1] ** 2, vehicle[1][0] * vehicle[1][2] ** 2
    return (x[0], x[1], x[2], q[0], q[1], q[2], q[3], x[3], x[4], x[5], w[0], w[1], w[2],
            min(max(a[0] * T + mx[0] * M[0] + my[0] * M[1] + d[0] * M[2], low), high),
            min(max(a[1] * T + mx[1] * M[0] + my[1] * M[1] + d[1] * M[2], low), high),
            min(max(a[2] * T + mx[2] * M[0] + my[2] * M[1] + d[2] * M[2], low), high),
            min(max(a[3] * T + mx[3] * M[0] + my[3] * M[1] + d[3] * M[2], low), high))


class ReferenceRows:
    """Rows of the running reference, kept by control period."""

    def __init__(self, vehicle: tuple, floor: float) -> None:
        self._vehicle, self._floor = vehicle, floor
        self._source: Any = None
        self._rows: dict[int, tuple[float, ...]] = {}

    def fill(self, source: Any, elapsed: float, spacing: int, out: np.ndarray) -> None:
        """Write the rows of all nodes.

        Args:
            source: reference with `setpoint(t)`.
            elapsed: time of the first node since the source began [s].
            spacing: control periods between nodes.
            out: shape (nodes, 17).
        """
        if source is not self._source or len(self._rows) > _KEPT:
            self._source, self._rows = source, {}
        rows, first = self._rows, round(elapsed / CONTROL_PERIOD)
        for k in range(len(out)):
            index = first + k * spacing
            row = rows.get(index)
            if row is None:
                row = reference_row(source.setpoint(index * CONTROL_PERIOD).packed, self._floor, self._vehicle)
                rows[index] = row
            out[k] = row
