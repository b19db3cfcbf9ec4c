"""First-order models fitted to a record by output error; standard deviations come from the scatter between parts of the flight.

    w' = (rate_gain w_cmd(t - delay) - w) / rate_lag      f_z = T - drag_z v_z / mass,  T' = (thrust_gain T_cmd(t - delay) - T) / thrust_lag
    f_z = thrust_coefficient sum Omega^2 / mass - drag_z v_z / mass,  Omega' = (Omega_cmd - Omega) / motor_time_constant
    f_x = -drag_x v_x / mass + bias                         likewise y

The battery's curve is fitted to several records, one at each voltage.

A value that is not identifiable from the record is refused with a reason, and not written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt

import numpy as np
from scipy.optimize import least_squares

from perch_core.vehicle import GRAVITY, Vehicle
from perch_eval.identification.flight import Record
from perch_eval.identification.responses import Response, first_order_lag

PARTS = 6            # of the record, fitted one by one for the scatter
MIN_RATE = 0.3       # standard deviation of a command for a usable response [rad/s]
MIN_THRUST = 0.5     # [m/s^2]
MIN_SPEED = 0.25     # of the air along an axis, for its drag [m/s]
MIN_EXPLAINED = 0.9  # share of the response's variance that the model must explain
MIN_VOLTAGE_RANGE = 0.08  # between the greatest and the least voltage, as a share
MAX_MISFIT = 0.03    # of the thrust at a voltage from its curve, as a share
MAX_RELATIVE_SIGMA = 0.2  # standard deviation of an identified value, as a share of it
MAX_DELAY_SIGMA = 0.003   # of an identified delay [s]
AT_BOUND = 1e-3      # distance from a bound of a fit, as a share of its range, within which the bound determines the parameter


@dataclass(frozen=True)
class Estimate:
    """Identified value of the vehicle file.

    Attributes:
        key: key in the file, with the axis in brackets: `actuation.rate_lag[0]`.
        value, sigma: value and its standard deviation, in `unit`.
        reason: reason why the value is not identified; empty: it is.
    """

    key: str
    value: float
    sigma: float
    unit: str
    reason: str = ""

    def __str__(self) -> str:
        reason = f"   not identified: {self.reason}" if self.reason else ""
        return f"{self.key:32s} {self.value:10.4g} +- {self.sigma:.2g} {self.unit}{reason}"


@dataclass(frozen=True)
class Parameter:
    """Parameter of a fit: name, unit, start and bounds."""

    name: str
    unit: str
    start: float
    low: float
    high: float


LAG, GAIN = Parameter("lag", "s", 0.04, 1e-3, 0.5), Parameter("gain", "", 1.0, 0.2, 5.0)
RATE_OFFSET, DELAY = Parameter("offset", "rad/s", 0.0, -0.5, 0.5), Parameter("delay", "s", 0.005, -0.01, 0.1)
DRAG, BIAS = Parameter("drag / mass", "1/s", 0.1, -5.0, 5.0), Parameter("bias", "m/s^2", 0.0, -2.0, 2.0)


def _fit_parameters(model: Callable[[np.ndarray], np.ndarray], measured: np.ndarray,
                    parameters: Sequence[Parameter]) -> tuple[np.ndarray, np.ndarray, str]:
    """Fit the parameters of `model`.

    Returns:
        Their values; their standard deviations: scatter of fits to parts / sqrt(their number); and why the fit is none: a
        parameter at its bound, of which the scatter tells nothing; empty: it is one.
    """
    start, low, high = np.array([(one.start, one.low, one.high) for one in parameters]).T

    def fit(samples: slice, x0: Sequence[float] | np.ndarray) -> np.ndarray:
        return least_squares(lambda x: (model(x) - measured)[samples], x0, bounds=(low, high),
                             x_scale=np.maximum(np.abs(start), 1e-2), diff_step=1e-4).x

    whole, cuts = fit(slice(None), start), np.linspace(0, len(measured), PARTS + 1).astype(int)
    parts = np.array([fit(slice(a, b), whole) for a, b in zip(cuts, cuts[1:])])
    weight = np.array([np.var(measured[a:b]) for a, b in zip(cuts, cuts[1:])])  # a part without motion has no information
    weight /= max(weight.sum(), 1e-12)
    spread = np.sqrt(weight @ (parts - whole) ** 2)
    at_bound = (f"the {one.name} is at the bound of its fit, {bound:g} {one.unit}".rstrip() for one, value in zip(parameters, whole)
                for bound in (one.low, one.high) if abs(value - bound) < AT_BOUND * (one.high - one.low))
    return whole, spread * np.sqrt(np.sum(weight**2)), next(at_bound, "")


def _estimate(key: str, value: float, sigma: float, unit: str, reason: str, bound: float | None = None) -> Estimate:
    bound = MAX_RELATIVE_SIGMA * abs(value) if bound is None else bound
    if not reason and sigma == inf:
        reason = "it depends on the delay, which is not identified"
    elif not reason and sigma > bound:
        reason = f"its standard deviation of {sigma:.2g} {unit} is more than {bound:.2g}; fly longer, with larger commands".replace("  ", " ")
    return Estimate(key, float(value), float(sigma), unit, reason)


def _not_identifiable(response: Response, min_size: float, at_bound: str) -> str:
    """Return why a loop is not identifiable: commands below `min_size` (1 sigma), a parameter at its bound, or a poor fit of the
    model; empty: it is."""
    size = float(np.std(response.command))
    if size < min_size:
        return f"commands of {size:.2g} {response.unit} (1 sigma) are too small; {min_size:g} are needed"
    if at_bound:
        return at_bound
    if response.explained < MIN_EXPLAINED:
        return f"a first-order lag explains {100 * response.explained:.0f} % of the response; {100 * MIN_EXPLAINED:.0f} are needed"
    return ""


def rates(record: Record, axis: int, delay: float | None = None, spread: float = 0.0) -> tuple[list[Estimate], Response]:
    """Identify lag and gain of one axis of the rate loop and, if `delay` is None, its delay, which is the third value.

    Args:
        record: record of the flight.
        axis: index of the axis x, y or z.
        delay, spread: known delay and its standard deviation [s]. The latter adds to the lag's, as commands that are slow against
            the lag determine only the sum of lag and delay.
    """
    h, w, free, known = record.period, record.gyro[:, axis], delay is None, delay or 0.0
    assert record.rates is not None
    sent = record.rates[:, axis]

    def model(x: np.ndarray) -> np.ndarray:
        applied_delay = x[3] if free else known
        return first_order_lag(x[1] * record.commands_at(sent, applied_delay + h), x[0], h) + x[2]

    x, sigma, at_bound = _fit_parameters(model, w, (LAG, GAIN, RATE_OFFSET, *([DELAY] if free else [])))
    response = Response(f"rate about {'xyz'[axis]}", "rad/s", record.t, record.commands_at(sent, 0.0), w, model(x))
    reason = _not_identifiable(response, MIN_RATE, at_bound)
    estimates = [_estimate(f"actuation.rate_lag[{axis}]", x[0], float(np.hypot(sigma[0], spread)), "s", reason),
                 _estimate(f"actuation.rate_gain[{axis}]", x[1], sigma[1], "", reason)]
    return estimates + ([_estimate("actuation.delay", max(x[3], 0.0), sigma[3], "s", reason, MAX_DELAY_SIGMA)] if free else []), response


def thrust(record: Record, vehicle: Vehicle, delay: float, spread: float = 0.0) -> tuple[list[Estimate], Response]:
    """Identify lag and gain of the thrust (or of the rotors, if commanded), and the drag along z. For `spread` see `rates`."""
    h, f, rotors = record.period, record.accel[:, 2], record.rotor_speeds is not None
    sent = record.rotor_speeds if record.rotor_speeds is not None else record.thrust
    assert sent is not None
    keys = ("motor_time_constant", "thrust_coefficient") if rotors else ("actuation.thrust_lag", "actuation.thrust_gain")
    unit = vehicle.thrust_coefficient / vehicle.mass if rotors else 1.0
    u = record.commands_at(sent, h if rotors else delay + h)

    def model(x: np.ndarray) -> np.ndarray:
        lag, gain, drag = x
        specific_thrust = gain * unit * np.sum(first_order_lag(u, lag, h) ** 2, axis=1) if rotors else first_order_lag(gain * u, lag, h)
        return specific_thrust - drag * record.v_B[:, 2]

    x, sigma, at_bound = _fit_parameters(model, f, (LAG, GAIN, DRAG))
    command = unit * np.sum(u**2, axis=1) if rotors else u
    response = Response("specific thrust", "m/s^2", record.t, command, f, model(x))
    reason = _not_identifiable(response, MIN_THRUST, at_bound)
    scale = vehicle.thrust_coefficient if rotors else 1.0
    gain_sigma = float(np.hypot(sigma[1], x[1] * vehicle.imu.accel_bias_init / GRAVITY))  # the accelerometer's bias looks like thrust
    return [_estimate(keys[0], x[0], float(np.hypot(sigma[0], spread)), "s", reason),
            _estimate(keys[1], scale * x[1], scale * gain_sigma, "N s^2/rad^2" if rotors else "", reason),
            _drag(2, vehicle.mass * x[2], vehicle.mass * sigma[2], record, at_bound)], response


def battery(voltages: Sequence[float], gains: Sequence[Estimate], applied_exponent: float = 0.0) -> Estimate:
    """Identify the exponent k of thrust at equal throttle, (voltage / first voltage)^k, by weighted least squares on logarithms.

    The standard deviation follows from that of the gains, or from their scatter about the curve if it is larger.

    Args:
        voltages: voltages of the flights [V].
        gains: thrust gain of each flight.
        applied_exponent: exponent by which the throttle was already compensated for the voltage in these flights.
    """
    x = np.log(np.asarray(voltages) / voltages[0])
    y = np.log([gain.value / gains[0].value for gain in gains])[1:]
    noise = np.array([gain.sigma / gain.value for gain in gains])
    covariance = np.diag(noise[1:] ** 2) + noise[0] ** 2  # the first gain is in every ratio
    W, x1 = np.linalg.inv(covariance), x[1:]
    information = float(x1 @ W @ x1)
    correction = float(x1 @ W @ y / max(information, 1e-12))
    k, residual, free = applied_exponent + correction, y - correction * x1, len(y) - 1
    scatter = float(np.sqrt(max(float(residual @ W @ residual) / free, 1.0))) if free else 1.0
    sigma, spread = scatter / sqrt(max(information, 1e-12)), float(np.ptp(x))
    reason = next((one.reason for one in gains if one.reason), "")
    if not reason and spread < MIN_VOLTAGE_RANGE:
        reason = f"voltages are {100 * spread:.0f} % apart; {100 * MIN_VOLTAGE_RANGE:.0f} are needed"
    elif not reason and np.max(np.abs(residual), initial=0.0) > MAX_MISFIT:
        reason = f"a power of the voltage misses the thrust by {100 * np.max(np.abs(residual)):.0f} %; {100 * MAX_MISFIT:.0f} are allowed"
    elif not reason and not 0.5 <= k <= 4.0:
        reason = f"an exponent of {k:.2g} is outside the range of batteries, 0.5 to 4"
    return _estimate("actuation.battery.exponent", k, sigma, "", reason)


def drag(record: Record, vehicle: Vehicle, axis: int) -> Estimate:
    """Identify the linear drag along x or y, the only force along these axes in free air."""
    def model(x: np.ndarray) -> np.ndarray:
        return x[1] - x[0] * record.v_B[:, axis]

    x, sigma, at_bound = _fit_parameters(model, record.accel[:, axis], (DRAG, BIAS))
    return _drag(axis, vehicle.mass * x[0], vehicle.mass * sigma[0], record, at_bound)


def _drag(axis: int, value: float, sigma: float, record: Record, at_bound: str) -> Estimate:
    speed = float(np.std(record.v_B[:, axis]))
    reason = f"speeds of {speed:.2g} m/s (1 sigma) are too small; {MIN_SPEED:g} are needed" if speed < MIN_SPEED else ""
    return _estimate(f"drag[{axis}]", value, sigma, "N s/m", reason or at_bound or ("a negative drag" if value < 0.0 else ""))


def identify(record: Record, vehicle: Vehicle) -> tuple[list[Estimate], list[Response]]:
    """Identify all values of a vehicle from a record; return them and the responses for the plots."""
    estimates: list[Estimate] = []
    responses: list[Response] = []
    delay, spread = vehicle.actuation.delay, 0.0
    if record.rates is not None:
        # One delay for all: that of roll and pitch, which turn the thrust; a larger delay of yaw counts as its lag.
        delays = [rates(record, axis)[0][2] for axis in (0, 1)]
        tilt = [one for one in delays if not one.reason]
        spread = inf
        if tilt:
            delay = float(np.mean([one.value for one in tilt]))
            spread = float(np.hypot(np.std([one.value for one in tilt]), max(one.sigma for one in tilt)))
        axes = [rates(record, axis, delay, spread) for axis in range(3)]
        responses += [response for _, response in axes]
        estimates += [one for part, _ in axes for one in part]
        reason = "" if tilt else f"not identifiable from roll or pitch: {delays[0].reason}"
        estimates.append(_estimate("actuation.delay", delay, spread, "s", reason, MAX_DELAY_SIGMA))
    if record.thrust is not None or record.rotor_speeds is not None:
        part, response = thrust(record, vehicle, delay, spread)
        estimates, responses = [*estimates, *part[:2], drag(record, vehicle, 0), drag(record, vehicle, 1), part[2]], [*responses, response]
    return estimates, responses
