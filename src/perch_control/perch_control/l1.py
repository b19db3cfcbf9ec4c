"""L1 adaptive augmentation: disturbances that are not in the vehicle's model are estimated and compensated. [P: ref. 24]

A predictor of velocity and body rates runs beside the vehicle. With piecewise-constant adaptation the disturbance is, at
each sample, the one that would have caused the prediction error within the last period, times e^(-decay dt) (98 % of it at
500 Hz, 90 % at 100 Hz). A low-pass filter (the "L1" filter) separates the fast estimate from the compensation, and so sets the
bandwidth independently of the adaptation rate.

All quantities are accelerations: force / mass in W [m/s^2], moment / inertia in B [rad/s^2].
"""

from __future__ import annotations

from math import exp

from perch_core.jit import compiled
from perch_core.vector3 import axes_of, axpy, cross, limited, scale, times
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.geometric.controller import packed_vehicle
from perch_control.geometric.step import drag_compensation, wrench_of
from perch_control.rotor_lag import thrusts

_ZERO = (0.0,) * 6
_LONGEST_GAP = 0.06  # a longer time between samples starts the predictor anew [s]
_DECAY = 10.0         # of the prediction error: slow beside the adaptation, which removes it in each period [1/s]
_FORCE_MAX = 6.0      # largest acceleration that is made up for, below the bound of the position feedback [m/s^2]
_MOMENT_MAX = 60.0    # largest angular acceleration that is made up for, a quarter of what may be commanded [rad/s^2]


@compiled
def model_rates(state, f, vehicle):
    """Accelerations of the model: in W, gravity and drag included, and angular in B; 6 floats. [M:eq1]"""
    mass, J = vehicle[0][0], vehicle[0][1:4]
    T, Mx, My, Mz = wrench_of(f, vehicle[2])
    _, _, b3 = axes_of(state[6:10])
    w = state[10:13]
    drag = drag_compensation(state[6:10], state[3:6], vehicle[4], (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    a = axpy(T / mass, b3, (-drag[0], -drag[1], -drag[2] - GRAVITY))
    gyro = cross(w, times(J, w))
    return (a[0], a[1], a[2], (Mx - gyro[0]) / J[0], (My - gyro[1]) / J[1], (Mz - gyro[2]) / J[2])


@compiled
def adapted(predicted, measured, filtered, decay, dt, bandwidth, bounds):
    """One adaptation: disturbance of the last period, and its filtered value, 6 floats each.

    Args:
        predicted, measured: velocity in W and body rates, 6 floats.
        filtered: filtered value of the last sample, 6 floats.
        decay: of the prediction error [1/s].
        dt: time since the last sample [s].
        bandwidth: of the filter [rad/s].
        bounds: of the filtered force and moment [m/s^2, rad/s^2].
    """
    # sigma = -Phi^-1 e^(A dt) error, Phi = A^-1 (e^(A dt) - 1), A = -decay.
    e = exp(-decay * dt)
    gain = -decay * e / (1.0 - e)
    raw = (
        gain * (predicted[0] - measured[0]), gain * (predicted[1] - measured[1]), gain * (predicted[2] - measured[2]),
        gain * (predicted[3] - measured[3]), gain * (predicted[4] - measured[4]), gain * (predicted[5] - measured[5]),
    )
    k = 1.0 - exp(-bandwidth * dt)
    force = limited(axpy(k, raw[0:3], scale(1.0 - k, filtered[0:3])), bounds[0])
    moment = limited(axpy(k, raw[3:6], scale(1.0 - k, filtered[3:6])), bounds[1])
    return raw, (force[0], force[1], force[2], moment[0], moment[1], moment[2])


@compiled
def predicted_value(z, r0, r, d, m, dt):
    """One component of the prediction from the last sample to this one, by the trapezoidal rule; `z`, `d`, `m`: at the last one.

    Args:
        z, m: prediction and measurement.
        r0, r: accelerations of the model at the last sample and at this one.
        d: disturbance.
        dt: time between the samples [s].
    """
    return z + dt * (0.5 * (r + r0) + d - _DECAY * (z - m))


@compiled
def l1_step(state, speed, dt, last, filtered, bandwidth, vehicle):
    """Predictor, adaptation and filter at one sample.

    Args:
        state: p_WB, v_WB, q_WB (xyzw), w_WB_B, 13 floats.
        speed: present rotor speeds [rad/s], 4 floats.
        dt: time since the last sample [s]; 0: the predictor begins with this one.
        last: accelerations of the model, prediction, measurement and disturbance at the last sample, 6 floats each.
        filtered, bandwidth: as in `adapted`.
        vehicle: constants (see `packed_vehicle`).

    Returns:
        `last` of the next sample, and the filtered disturbance, 6 floats.
    """
    measured = (state[3], state[4], state[5], state[10], state[11], state[12])
    rates = model_rates(state, thrusts(speed, vehicle[1][0]), vehicle)
    if dt <= 0.0:
        return (rates, measured, measured, _ZERO), filtered
    r0, z, m, d = last
    predicted = (
        predicted_value(z[0], r0[0], rates[0], d[0], m[0], dt), predicted_value(z[1], r0[1], rates[1], d[1], m[1], dt),
        predicted_value(z[2], r0[2], rates[2], d[2], m[2], dt), predicted_value(z[3], r0[3], rates[3], d[3], m[3], dt),
        predicted_value(z[4], r0[4], rates[4], d[4], m[4], dt), predicted_value(z[5], r0[5], rates[5], d[5], m[5], dt),
    )
    raw, filtered = adapted(predicted, measured, filtered, _DECAY, dt, bandwidth, (_FORCE_MAX, _MOMENT_MAX))
    return (rates, predicted, measured, raw), filtered


class L1Augmentation:
    """Owns predictor and filter.

    Attributes:
        disturbance: filtered estimate, acceleration in W and angular acceleration in B, 6 floats.
    """

    def __init__(self, vehicle: Vehicle, bandwidth: float = 15.0) -> None:
        """`bandwidth`: of the filtered estimate, force and moment [rad/s]; it may change in flight."""
        self.bandwidth = bandwidth
        self._vehicle = packed_vehicle(vehicle)
        self.disturbance: tuple[float, ...] = _ZERO
        self.reset()

    def reset(self) -> None:
        """Reset the disturbance and the predictor: the vehicle may be on the ground, it recovers, or its model has changed."""
        self.disturbance = _ZERO
        self._time: float | None = None  # of the last sample [s]; None: the predictor begins with the next one
        self._last = (_ZERO,) * 4  # see `l1_step`

    def set_vehicle(self, vehicle: Vehicle, explained: tuple[float, ...] | None = None) -> None:
        """Use another model of the vehicle.

        Args:
            vehicle: the model.
            explained: acceleration in W that the new model explains [m/s^2], 3 floats: the rest of the estimate is kept; None:
                the estimate is reset.
        """
        self._vehicle = packed_vehicle(vehicle)
        kept = self.disturbance
        self.reset()
        if explained is not None:
            self.disturbance = (*axpy(-1.0, explained, kept[0:3]), *kept[3:6])

    def hold(self) -> tuple[float, ...]:
        """Return the compensation without adaptation, while the vehicle may be in contact."""
        self._time = None
        return self._compensation

    def update(self, state: tuple[float, ...], speed: tuple[float, ...], now: float) -> tuple[float, ...]:
        """Adapt to a state; returns the compensation of the disturbance, 6 floats (see `geometric_step`).

        Args:
            state: p_WB, v_WB, q_WB (xyzw), w_WB_B, 13 floats.
            speed: present rotor speeds [rad/s], 4 floats.
            now: time of the state [s].
        """
        dt = 0.0 if self._time is None else now - self._time
        self._time = now
        self._last, self.disturbance = l1_step(state, speed, dt if 0.0 < dt < _LONGEST_GAP else 0.0, self._last, self.disturbance,
                                               self.bandwidth, self._vehicle)
        return self._compensation

    @property
    def _compensation(self) -> tuple[float, ...]:
        a, b, c, d, e, f = self.disturbance
        return -a, -b, -c, -d, -e, -f
