"""Simulated flight before the real one, so that no compiled code is called for the first time in flight.

The first call of a kernel loads it from its cache, which takes milliseconds. Otherwise, all kernels of a descent without
position would be loaded at the moment at which odometry fails.
"""

from __future__ import annotations

import numpy as np

from perch_control.admission import AtEnd, Order
from perch_control.flight import FlightController
from perch_control.flight_settings import FlightSettings
from perch_control.geometric import GeometricController
from perch_control.l1 import L1Augmentation
from perch_control.maneuvers import recovered
from perch_control.modes import State
from perch_control.period import NOMINAL_PERIOD
from perch_control.reference import FlatReference, SampledReference, Vector
from perch_core.trajectory import SampledTrajectory, rest_to_rest
from perch_core.values import Command
from perch_core.vehicle import GRAVITY, ControlGains, Vehicle

_RISE = 1.0  # [s]


class _DryRun:
    """A flight controller with ideal odometry: the vehicle is exactly where it is expected."""

    def __init__(self, flight: FlightController) -> None:
        self.flight, self.time = flight, 1.0

    def step(self, count: int = 3) -> None:
        """Run a number of control periods."""
        for _ in range(count):
            self.time += NOMINAL_PERIOD
            p, v = self._expected()
            self.flight.imu(self.time, (0.0, 0.0, 0.0), (0.0, 0.0, GRAVITY))
            self.flight.step(self.time, (*p, *v, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))

    def rise(self, id: int, end: float, at_end: AtEnd) -> None:
        """Follow a trajectory to the height `end` [m]."""
        self._follow(id, FlatReference(rest_to_rest(np.array(self._expected()[0]), np.array([0.0, 0.0, end]), 0.0, 0.0, _RISE)), at_end)

    def stay(self, id: int, at_end: AtEnd) -> None:
        """Follow a trajectory of full states that stays at the expected position."""
        mass, still = self.flight.vehicle.mass, np.zeros((2, 3))
        path = SampledTrajectory(np.array([0.0, _RISE]), np.tile(self._expected()[0], (2, 1)), np.tile((0.0, 0.0, 0.0, 1.0), (2, 1)), still,
                                 still, still, still, np.full((2, 4), mass * GRAVITY / 4))
        self._follow(id, SampledReference(path, mass), at_end)

    def _follow(self, id: int, source: FlatReference | SampledReference, at_end: AtEnd) -> None:
        self.flight.follow(Order(id, source, self.time + NOMINAL_PERIOD, at_end))

    def _expected(self) -> tuple[Vector, Vector]:
        """Expected position [m] and velocity [m/s]; at rest at the origin while not flying."""
        if not self.flight.flight_state.flying:
            return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        at = self.flight.flight_state.expected(self.time)
        return at.p, at.v


def dry_run(vehicle: Vehicle, gains: ControlGains, settings: FlightSettings) -> list[State]:
    """Arm, rise, hover, begin a perch with each type of plan, recover, land, and descend without position, a few periods each.

    Returns:
        The controller's states in the course of it.
    """
    flight = FlightController(vehicle, GeometricController(vehicle, gains), gains, settings)
    flight.compensator = L1Augmentation(vehicle)
    run, states = _DryRun(flight), []
    run.step()
    flight.command(Command.ARM)
    states.append(flight.state)
    run.rise(1, 0.2, AtEnd.HOLD)
    run.step(round(_RISE / NOMINAL_PERIOD) + 5)
    states.append(flight.state)
    run.stay(2, AtEnd.CONTACT)
    run.step()
    run.rise(3, 0.4, AtEnd.CONTACT)
    run.step()
    states.append(flight.state)
    flight.flight_state = recovered(flight.flight_state, "dry run")
    run.step()
    states.append(flight.state)
    flight.command(Command.LAND)
    run.step()
    states.append(flight.state)
    flight.step_blind(run.time + 0.1)
    for k in range(1, 4):
        flight.imu(run.time + 0.1 + k * NOMINAL_PERIOD, (0.0, 0.0, 0.0), (0.0, 0.0, GRAVITY))
        flight.step_blind(run.time + 0.1 + k * NOMINAL_PERIOD)
    return states
