"""Choice of the mapped powerlines for the predictive controller: the one to keep in view first, then the nearest. [P:VI-A]"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perch_control.nmpc.model import LINES
from perch_core.lines import Segment

PackedLine = tuple[float, ...]
"""Centre (3), direction (3), half length, radius [m]."""


def chosen_lines(segments: Sequence[Segment], p_WB: np.ndarray, watched: Sequence[float]) -> tuple[PackedLine, ...]:
    """The lines for the soft terms, at most `LINES`.

    Args:
        segments: the map.
        p_WB: position of the vehicle in W [m], shape (3,).
        watched: a rough point on the line to keep in view in W [m], 3 floats; empty: the line nearest to the vehicle.

    Returns:
        Packed lines; the first is kept in view, all are kept at a distance.
    """
    if not segments:
        return ()
    point = np.array(watched if len(watched) else p_WB, float)
    first = min(segments, key=lambda s: float(s.distance(point)))
    others = sorted((s for s in segments if s is not first), key=lambda s: float(s.distance(np.asarray(p_WB, float))))
    return tuple((*s.centre.tolist(), *s.direction.tolist(), float(s.half_length), float(s.radius))
                 for s in (first, *others[:LINES - 1]))
