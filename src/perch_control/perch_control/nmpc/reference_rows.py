"""References of the shooting nodes: full states and rotor thrusts by flatness, each computed once.

The nodes are a whole number of control periods apart, so that the row of the last node serves every other node later: in
steady flight one new row per period is enough. Rows have the phase of the first call; where it changes, all are recomputed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_control.reference import packed_many
from perch_core.flatness import commanded_frame
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, dot, norm, quaternion_of, times
from perch_core.vehicle import GRAVITY

_EMPTY = -(1 << 62)
_PHASE_TOLERANCE = 0.25  # of a period, beyond which the phase of the rows is another one


@compiled
def _three(x, k):
    """Components k to k + 2 as a tuple."""
    return (x[k], x[k + 1], x[k + 2])


@compiled
def reference_row(x, floor, vehicle):
    """p, q, v, w and rotor thrusts of a setpoint, 17 floats. [M:eq9-13]

    If a setpoint carries its b3, this is kept, whatever a transition between references adds to its acceleration: at very low
    thrust, a small acceleration would be a large turn. The thrust is then the component of the force along b3.

    Args:
        x: packed setpoint, 33 floats (a tuple or an array).
        floor: specific thrust below which the attitude is taken as level [m/s^2].
        vehicle: packed constants (see `packed_vehicle`).
    """
    f = (x[6], x[7], x[8] + GRAVITY)
    j, s = _three(x, 9), _three(x, 12)
    thrust = norm(f)
    if dot(_three(x, 24), _three(x, 24)) > 0.5:
        thrust = max(dot(f, _three(x, 24)), 0.0)
        f, j, s = _three(x, 24), _three(x, 27), _three(x, 30)
    elif thrust < floor:
        thrust = floor
        f, j, s = (0.0, 0.0, floor), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    h, dh, ddh = _three(x, 15), _three(x, 18), _three(x, 21)
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


@compiled
def missing_periods(stamps, first, spacing, nodes):
    """Periods of the nodes whose rows are not in the ring buffer."""
    out = np.empty(nodes, np.int64)
    n = 0
    for k in range(nodes):
        index = first + k * spacing
        if stamps[index % len(stamps)] != index:
            out[n] = index
            n += 1
    return out[:n]


@compiled
def store_rows(setpoints, periods, floor, vehicle, rows, stamps):
    """Write the rows of packed setpoints (n, 33) to the ring buffer, at their periods (n,)."""
    for k in range(len(periods)):
        slot = periods[k] % len(stamps)
        row = reference_row(setpoints[k], floor, vehicle)
        for i in range(17):
            rows[slot, i] = row[i]
        stamps[slot] = periods[k]


@compiled
def copy_rows(rows, stamps, first, spacing, out):
    """Copy the rows of all nodes from the ring buffer to `out`."""
    for k in range(len(out)):
        out[k] = rows[(first + k * spacing) % len(stamps)]


class ReferenceRows:
    """Rows of the running reference, stored by control period in a ring buffer as long as the horizon."""

    def __init__(self, vehicle: tuple, floor: float, periods: int, period: float) -> None:
        """
        Args:
            vehicle: packed constants.
            floor: see `reference_row`.
            periods: length of the horizon in control periods.
            period: control period [s].
        """
        self._vehicle, self._floor, self._period = vehicle, floor, period
        self._source: Any = None
        self._phase = 0.0  # of the rows, after whole periods [s]
        self._rows, self._stamps = np.zeros((periods + 1, 17)), np.full(periods + 1, _EMPTY)

    def fill(self, source: Any, elapsed: float, spacing: int, out: np.ndarray) -> None:
        """Write the rows of all nodes.

        Args:
            source: reference with `setpoint(t)`.
            elapsed: time of the first node since the source began [s].
            spacing: control periods between nodes.
            out: shape (nodes, 17).
        """
        first = round((elapsed - self._phase) / self._period)
        if source is not self._source or abs(elapsed - self._phase - first * self._period) > _PHASE_TOLERANCE * self._period:
            self._source = source
            self._stamps[:] = _EMPTY
            first = round(elapsed / self._period)
            self._phase = elapsed - first * self._period
        periods = missing_periods(self._stamps, first, spacing, len(out))
        if len(periods):
            store_rows(packed_many(source, periods * self._period + self._phase), periods, self._floor, self._vehicle, self._rows,
                       self._stamps)
        copy_rows(self._rows, self._stamps, first, spacing, out)
