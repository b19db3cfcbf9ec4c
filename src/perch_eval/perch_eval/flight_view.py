"""Data of a flight for display, alone or beside others: states, surroundings, camera images, time of the perch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_core.vehicle import Vehicle
from perch_eval.flight import Flight, States
from perch_eval.metrics import perch_window

TRUTH, ESTIMATE, REFERENCE, LIMIT = "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728"
PAD = 0.3  # half of the pad's side [m]
SQUARE = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])


@dataclass(frozen=True)
class FlightView:
    """Data of a flight for display.

    Attributes:
        name, colour: to distinguish several flights on a page.
        flight, vehicle: the recording, and the vehicle that flew.
        truth: true states.
        estimate, reference: estimated and reference states, where recorded.
        pad: true pose of the pad p (3,), R (3, 3), where there is one.
        cables: end points of mapped wires, (n, 2, 3).
        start, end: of the perch, or of the recording where there is none [s].
        until: end of what is shown [s].
    """

    name: str
    colour: str
    flight: Flight
    vehicle: Vehicle
    truth: States
    estimate: States | None
    reference: States | None
    pad: tuple[np.ndarray, np.ndarray] | None
    cables: np.ndarray
    start: float
    end: float
    until: float

    @classmethod
    def from_flight(cls, flight: Flight, vehicle: Vehicle, name: str = "", colour: str = TRUTH, until: float = np.inf) -> FlightView:
        """Collect the data of a recording, to be shown up to a time [s].

        Raises:
            PerchError: the recording has no true states.
        """
        truth, pad = flight.known_states("ground_truth/odometry"), None
        if targets := flight.values("ground_truth/target"):
            pad = np.array(targets[-1][1].p), so3.quat_to_matrix(np.array(targets[-1][1].q))
        lines = flight.values("powerlines")
        cables = np.array([[line.start, line.end] for line in lines[-1][1].lines]) if lines else np.zeros((0, 2, 3))
        last = max(float(truth.t[0]), min(float(truth.t[-1]), until))
        window = perch_window(flight) or (float(truth.t[0]), last)
        return cls(name, colour, flight, vehicle, truth, flight.states("odometry"), flight.reference(), pad, cables.reshape(-1, 2, 3),
                   *window, last)

    def around(self, before: float, after: float) -> tuple[float, float]:
        """Return the time span of the perch with margins before and after it, as far as it is recorded and shown [s]."""
        return max(float(self.truth.t[0]), self.start - before), min(self.until, self.end + after)

    @property
    def pad_corners(self) -> np.ndarray | None:
        """Corners of the pad in W [m], shape (4, 3); None if there is no pad."""
        return None if self.pad is None else self.pad[0] + PAD * SQUARE @ self.pad[1][:, :2].T
