"""Check whether the geometric law can fly a contact trajectory, by a compiled simulation on the vehicle's model.

A plan respects the limits of the rotors' thrusts, but not their lag. Where b3 has to turn far and the thrust at the contact is
low, as under an overhang, following the plan requires commands beyond the rotors' range: the law would end slower, faster or
elsewhere than planned, in the same way each time. This can be computed before the flight.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perch_core.flatness import commanded_frame
from perch_core.jit import compiled
from perch_core.vector3 import quaternion_of
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.geometric.law import cone_before_contact
from perch_control.geometric.step import control_step, drag_compensation, predicted
from perch_control.reference import Setpoint, Source, packed_many
from perch_control.rotor_lag import RotorEstimate, approached, lag_share, thrusts

if TYPE_CHECKING:
    from perch_control.geometric.controller import GeometricController

SPAN = 1.5  # the last part of the trajectory is flown [s]


@compiled
def simulate(start, speed, table, gains, limits, settling, lead, lag, period, vehicle):
    """State at the end of a simulated flight of the geometric controller; see `GeometricController.end_on_model`."""
    state, command = start, speed
    duration, mass, J = len(table) * period, vehicle[0][0], vehicle[0][1:4]
    coefficient, _, _, tau = vehicle[1]
    share, middle = lag_share(period, tau), lag_share(0.5 * period, tau)
    none = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(len(table)):
        r = table[k]
        reference = (r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11], r[12], r[13], r[14], r[15],
                     r[16], r[17], r[18], r[19], r[20], r[21], r[22], r[23],
                     r[24], r[25], r[26], r[27], r[28], r[29], r[30], r[31], r[32])
        cone = cone_before_contact(duration - k * period, limits[1], settling)
        command = control_step(state, reference, speed, command, none, gains,
                               (limits[0], cone, limits[2], limits[3], limits[4]), lead, lag, vehicle)[0]
        f = thrusts(approached(speed, command, middle), coefficient)
        compensation = drag_compensation(state[6:10], state[3:6], vehicle[4], none)
        state = predicted(state, f, compensation, period, mass, J, vehicle[2])
        speed = approached(speed, command, share)
    return np.array(state)


def contact_error(source: Source, controller: GeometricController) -> tuple[float, float]:
    """Error of the law at the end of a trajectory on the vehicle model, simulated from the reference `SPAN` before the end on.

    Args:
        source: the trajectory.
        controller: the law, with its vehicle, gains and period.

    Returns:
        Difference from the planned position [m] and velocity [m/s] at the end.
    """
    T, period = source.duration, controller.period
    n = int(min(SPAN, T) / period)
    table = packed_many(source, T - n * period + np.arange(n) * period + controller.lag)
    start, rotors = _state_on_reference(source.setpoint(T - n * period), controller.vehicle)
    end, wanted = controller.end_on_model(start, rotors, table), source.setpoint(T)
    return float(np.linalg.norm(end[0:3] - wanted.p)), float(np.linalg.norm(end[3:6] - wanted.v))


def _state_on_reference(x: Setpoint, vehicle: Vehicle) -> tuple[np.ndarray, RotorEstimate]:
    """State and rotors of a vehicle that is exactly on a setpoint."""
    f = (x.a[0], x.a[1], x.a[2] + GRAVITY)
    b1, b2, b3, w, _ = commanded_frame(f, x.j, x.s, x.h, x.dh, x.ddh)
    speed = float(np.sqrt(vehicle.mass * np.linalg.norm(f) / 4.0 / vehicle.thrust_coefficient))
    return np.array([*x.p, *x.v, *quaternion_of(b1, b2, b3), *w]), RotorEstimate((speed,) * 4, (speed,) * 4)
