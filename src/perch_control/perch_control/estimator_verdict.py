"""Consequence of the estimator's health for a flight."""

from __future__ import annotations

from typing import NamedTuple

_COASTING, _DIVERGED = 2, 3  # perch_msgs/EstimatorStatus
_COASTING_HOVER = 1.0        # no VIO for so long: hover; the position drifts by centimetres until then [s]
_COASTING_LAND = 3.0         # the same: descend without position [s]


class EstimatorVerdict(NamedTuple):
    """What of the estimate can be used.

    Attributes:
        problem: why the running manoeuvre must end; empty: the estimate is usable.
        position, velocity: whether these can be relied on until the vehicle is at rest.
    """

    problem: str = ""
    position: bool = True
    velocity: bool = True

    @classmethod
    def of(cls, state: int, vio_age: float, message: str) -> EstimatorVerdict:
        """Return the verdict on a status: state as in `perch_msgs/EstimatorStatus`, age of the last VIO measurement [s]."""
        if state == _DIVERGED:
            return cls(f"the estimator has diverged: {message}", False, False)
        if state == _COASTING and vio_age > _COASTING_HOVER:
            return cls(f"no VIO for {vio_age:.1f} s", vio_age <= _COASTING_LAND)
        return cls()
