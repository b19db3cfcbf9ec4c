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
from perch_eval.identification.answers import Answer, lagged
from perch_eval.identification.record import Record

PARTS = 6            # of the record, fitted one by one for the scatter
LEAST_RATE = 0.3     # standard deviation of a command below which nothing can be seen in the answer [rad/s]
LEAST_THRUST = 0.5   # [m/s^2]
LEAST_SPEED = 0.25   # of the air along an axis, for its drag [m/s]
EXPLAINED = 0.9      # share of the answer's variance that the model must explain
LEAST_VOLTAGES = 0.08  # between the greatest and the least voltage, as a share
MISFIT = 0.03        # of the thrust at a voltage from its curve, as a share
CERTAIN = 0.2        # a value is told where its standard deviation is below this share of it ...
DELAY_CERTAIN = 0.003  # ... and a delay below this [s]


@dataclass(frozen=True)
class Found:
    """Identified value of the vehicle file.

    Attributes:
        key: key in the file, with the axis in brackets: `actuation.rate_lag[0]`.
        value, sigma: value and its standard deviation, in `unit`.
        refused: reason why the value is not identified; empty: it is.
    """

    key: str
    value: float
    sigma: float
    unit: str
    refused: str = ""

    def __str__(self) -> str:
        refused = f"   not identified: {self.refused}" if self.refused else ""
        return f"{self.key:32s} {self.value:10.4g} +- {self.sigma:.2g} {self.unit}{refused}"


def _fitted(model: Callable[[np.ndarray], np.ndarray], measured: np.ndarray, start: Sequence[float], low: Sequence[float],
            high: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Fit the parameters of `model`; return them and their standard deviations: scatter of fits to parts / sqrt(their number)."""
    def fit(samples: slice, x0: Sequence[float] | np.ndarray) -> np.ndarray:
        return least_squares(lambda x: (model(x) - measured)[samples], x0, bounds=(low, high),
                             x_scale=np.maximum(np.abs(start), 1e-2), diff_step=1e-4).x

    whole, cuts = fit(slice(None), start), np.linspace(0, len(measured), PARTS + 1).astype(int)
    parts = np.array([fit(slice(a, b), whole) for a, b in zip(cuts, cuts[1:])])
    weight = np.array([np.var(measured[a:b]) for a, b in zip(cuts, cuts[1:])])  # a part in which nothing happens tells nothing
    weight /= max(weight.sum(), 1e-12)
    spread = np.sqrt(weight @ (parts - whole) ** 2)
    return whole, spread * np.sqrt(np.sum(weight**2))


def _judged(key: str, value: float, sigma: float, unit: str, why: str, bound: float | None = None) -> Found:
    bound = CERTAIN * abs(value) if bound is None else bound
    if not why and sigma == inf:
        why = "it depends on the delay, which is not identified"
    elif not why and sigma > bound:
        why = f"its standard deviation of {sigma:.2g} {unit} is more than {bound:.2g}; fly longer and harder".replace("  ", " ")
    return Found(key, float(value), float(sigma), unit, why)


def _untold(answer: Answer, least: float) -> str:
    """Return why a loop is not identifiable: commands below `least` (1 sigma), or a poor fit of the model; empty: it is."""
    size = float(np.std(answer.command))
    if size < least:
        return f"commands of {size:.2g} {answer.unit} (1 sigma) are too small; {least:g} are needed"
    if answer.explained < EXPLAINED:
        return f"a lag of first order explains {100 * answer.explained:.0f} % of the answer; {100 * EXPLAINED:.0f} are needed"
    return ""


def rates(record: Record, axis: int, delay: float | None = None, spread: float = 0.0) -> tuple[list[Found], Answer]:
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
        late = x[3] if free else known
        return lagged(x[1] * record.commanded(sent, late + h), x[0], h) + x[2]

    n = 4 if free else 3
    x, sigma = _fitted(model, w, (0.04, 1.0, 0.0, 0.005)[:n], (1e-3, 0.2, -0.5, -0.01)[:n], (0.5, 5.0, 0.5, 0.1)[:n])
    answer = Answer(f"rate about {'xyz'[axis]}", "rad/s", record.t, record.commanded(sent, 0.0), w, model(x))
    why = _untold(answer, LEAST_RATE)
    found = [_judged(f"actuation.rate_lag[{axis}]", x[0], float(np.hypot(sigma[0], spread)), "s", why),
             _judged(f"actuation.rate_gain[{axis}]", x[1], sigma[1], "", why)]
    return found + ([_judged("actuation.delay", max(x[3], 0.0), sigma[3], "s", why, DELAY_CERTAIN)] if free else []), answer


def thrust(record: Record, vehicle: Vehicle, delay: float, spread: float = 0.0) -> tuple[list[Found], Answer]:
    """Identify lag and gain of the thrust (or of the rotors, if commanded), and the drag along z. For `spread` see `rates`."""
    h, f, rotors = record.period, record.accel[:, 2], record.rotor_speeds is not None
    sent = record.rotor_speeds if record.rotor_speeds is not None else record.thrust
    assert sent is not None
    keys = ("motor_time_constant", "thrust_coefficient") if rotors else ("actuation.thrust_lag", "actuation.thrust_gain")
    unit = vehicle.thrust_coefficient / vehicle.mass if rotors else 1.0
    u = record.commanded(sent, h if rotors else delay + h)

    def model(x: np.ndarray) -> np.ndarray:
        lag, gain, drag = x
        felt = gain * unit * np.sum(lagged(u, lag, h) ** 2, axis=1) if rotors else lagged(gain * u, lag, h)
        return felt - drag * record.v_B[:, 2]

    x, sigma = _fitted(model, f, (0.04, 1.0, 0.05), (1e-3, 0.2, -5.0), (0.5, 5.0, 5.0))
    command = unit * np.sum(u**2, axis=1) if rotors else u
    answer = Answer("specific thrust", "m/s^2", record.t, command, f, model(x))
    why = _untold(answer, LEAST_THRUST)
    scale = vehicle.thrust_coefficient if rotors else 1.0
    certain = float(np.hypot(sigma[1], x[1] * vehicle.imu.accel_bias_init / GRAVITY))  # the accelerometer's own offset looks like thrust
    return [_judged(keys[0], x[0], float(np.hypot(sigma[0], spread)), "s", why),
            _judged(keys[1], scale * x[1], scale * certain, "N s^2/rad^2" if rotors else "", why),
            _drag(2, vehicle.mass * x[2], vehicle.mass * sigma[2], record)], answer


def battery(voltages: Sequence[float], gains: Sequence[Found], flown: float = 0.0) -> Found:
    """Identify the exponent k of thrust at equal throttle, (voltage / first voltage)^k, by weighted least squares on logarithms.

    The standard deviation follows from that of the gains, or from their scatter about the curve if it is larger.

    Args:
        voltages: voltages of the flights [V].
        gains: thrust gain of each flight.
        flown: exponent by which the throttle was already compensated for the voltage in these flights.
    """
    x = np.log(np.asarray(voltages) / voltages[0])
    y = np.log([gain.value / gains[0].value for gain in gains])[1:]
    noise = np.array([gain.sigma / gain.value for gain in gains])
    covariance = np.diag(noise[1:] ** 2) + noise[0] ** 2  # the first gain is in every ratio
    W, x1 = np.linalg.inv(covariance), x[1:]
    information = float(x1 @ W @ x1)
    more = float(x1 @ W @ y / max(information, 1e-12))
    k, left, free = flown + more, y - more * x1, len(y) - 1
    scatter = float(np.sqrt(max(float(left @ W @ left) / free, 1.0))) if free else 1.0
    sigma, spread, why = scatter / sqrt(max(information, 1e-12)), float(np.ptp(x)), next((one.refused for one in gains if one.refused), "")
    if not why and spread < LEAST_VOLTAGES:
        why = f"voltages are {100 * spread:.0f} % apart; {100 * LEAST_VOLTAGES:.0f} are needed"
    elif not why and np.max(np.abs(left), initial=0.0) > MISFIT:
        why = f"a power of the voltage misses the thrust by {100 * np.max(np.abs(left)):.0f} %; {100 * MISFIT:.0f} are allowed"
    elif not why and not 0.5 <= k <= 4.0:
        why = f"an exponent of {k:.2g} is no battery's: 0.5 to 4"
    return _judged("actuation.battery.exponent", k, sigma, "", why)


def drag(record: Record, vehicle: Vehicle, axis: int) -> Found:
    """Identify the linear drag along x or y, the only force along these axes in free air."""
    def model(x: np.ndarray) -> np.ndarray:
        return x[1] - x[0] * record.v_B[:, axis]

    x, sigma = _fitted(model, record.accel[:, axis], (0.1, 0.0), (-5.0, -2.0), (5.0, 2.0))
    return _drag(axis, vehicle.mass * x[0], vehicle.mass * sigma[0], record)


def _drag(axis: int, value: float, sigma: float, record: Record) -> Found:
    speed = float(np.std(record.v_B[:, axis]))
    why = f"speeds of {speed:.2g} m/s (1 sigma) are too small; {LEAST_SPEED:g} are needed" if speed < LEAST_SPEED else ""
    return _judged(f"drag[{axis}]", value, sigma, "N s/m", why or ("a negative drag" if value < 0.0 else ""))


def identify(record: Record, vehicle: Vehicle) -> tuple[list[Found], list[Answer]]:
    """Identify all values of a vehicle from a record; return them and the responses for the plots."""
    found: list[Found] = []
    answers: list[Answer] = []
    delay, spread = vehicle.actuation.delay, 0.0
    if record.rates is not None:
        # One delay for all: that of roll and pitch, which turn the thrust; what yaw is later counts as its lag.
        tilt = [part[2] for part, _ in (rates(record, axis) for axis in (0, 1)) if not part[2].refused]
        spread = inf
        if tilt:
            delay = float(np.mean([one.value for one in tilt]))
            spread = float(np.hypot(np.std([one.value for one in tilt]), max(one.sigma for one in tilt)))
        axes = [rates(record, axis, delay, spread) for axis in range(3)]
        answers += [answer for _, answer in axes]
        found += [one for part, _ in axes for one in part]
        found.append(_judged("actuation.delay", delay, spread, "s", "" if tilt else "neither roll nor pitch tells it",
                             DELAY_CERTAIN))
    if record.thrust is not None or record.rotor_speeds is not None:
        part, answer = thrust(record, vehicle, delay, spread)
        found, answers = [*found, *part[:2], drag(record, vehicle, 0), drag(record, vehicle, 1), part[2]], [*answers, answer]
    return found, answers
