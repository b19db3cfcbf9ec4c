"""Interactive 3-D view of flights for a page: it can be rotated and played back, and works offline.

It is drawn on a canvas by `scene_3d.js`, as the usual libraries would add megabytes to each report or need a network.
"""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perch_eval.flight_view import FlightView

PERIOD = 0.02     # between instants that are shown [s]
BEFORE, AFTER = 1.5, 1.0  # shown around a perch; a flight alone is shown to its end [s]


def scene_3d(views: Sequence[FlightView]) -> str:
    """Return the view as a part of a page.

    Args:
        views: flights to show; with several, the time of each is relative to the start of its perch.
    """
    legend = "".join(f'<span style="color:{view.colour}">&#9632;</span> {html.escape(view.name)} &nbsp; ' for view in views)
    alone = len(views) == 1
    flights = [_flight(view, 0.0 if alone else view.start, np.inf if alone else AFTER) for view in views]
    script = Path(__file__).with_suffix(".js").read_text()
    data = json.dumps({"flights": flights}, separators=(",", ":")).replace("</", "<\\/")
    return ('<div><canvas width="1100" height="620" style="width:100%;touch-action:none;cursor:grab;background:#fafafa"></canvas>'
            '<div><button type="button">play</button> <input type="range" min="0" max="1000" value="1000" style="width:70%" '
            'aria-label="time"> <output></output></div>'
            f'<p>{legend}thin: reference. Drag to turn, drag with Shift to move, turn the wheel to zoom.</p>'
            f'<script type="application/json">{data}</script><script>{script}</script></div>')


def _flight(view: FlightView, zero: float, after: float) -> dict[str, Any]:
    start, end = view.around(BEFORE, after)
    times = np.linspace(start, end, 1 + round((end - start) / PERIOD))
    states, reference = view.truth.at(times), view.reference
    reference_path = np.empty((0, 3)) if reference is None else reference.p[(reference.t >= start) & (reference.t <= end)][::2]
    return {"colour": view.colour, "t": _rounded(times - zero), "p": _rounded(states.p), "q": _rounded(states.q, 4),
            "rotors": _rounded(view.vehicle.rotor_xy), "reference": _rounded(reference_path), "cables": _rounded(view.cables),
            "pad": [] if view.pad_corners is None else _rounded(view.pad_corners)}


def _rounded(values: Any, digits: int = 3) -> list[Any]:
    return np.round(np.asarray(values, float), digits).tolist()
