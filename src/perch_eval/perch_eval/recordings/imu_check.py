"""Checks of IMU samples (units, range, rest, biases, noise), and the findings of a check: what would make perception fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from perch_core.sensors import ImuSensor
from perch_core.values import InertialState
from perch_core.vehicle import GRAVITY

OK, WARNING, FAILS = "ok", "warning", "fails"
RATE_MAX = 10_000.0  # rate of a sensor [Hz]
RATE_TOLERANCE = 0.01  # share by which a rate may lie below a bound: clocks differ
STILL_WINDOW = 0.2  # [s]
STILL_MEAN = (0.02, 0.2)  # by how much a window's mean may differ from those before it, at rest [rad/s, m/s^2]
GYRO_BIAS_MAX = 0.2  # mean at rest above which a warning is given, whatever the sensor file allows [rad/s]
BIAS_SIGMAS = 3.0  # by how many sigma of the turn-on bias a mean at rest, or an estimate, may be off
STILL_SIGMA = (0.3, 2.0)  # 1 sigma within a window: rotors that idle shake the vehicle, but do not move it [rad/s, m/s^2]


class Finding(NamedTuple):
    """One line of the check: `ok`, `warning` or `fails`, what it is about, and what was found."""

    level: str
    about: str
    text: str


@dataclass
class Report:
    """All findings, and the figures behind them."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)

    def add(self, about: str, text: str, warning: bool = False, fails: bool = False) -> None:
        """Add a finding."""
        self.findings.append(Finding(FAILS if fails else WARNING if warning else OK, about, text))

    @property
    def fails(self) -> bool:
        """Whether something would make perception fail."""
        return any(finding.level == FAILS for finding in self.findings)


def check_rate(report: Report, about: str, stamps: np.ndarray, minimum: float, recommended: float, nominal: float | None) -> float:
    """Check rate, jitter (1 sigma of an interval, in periods) and gaps of ascending stamps (three or more); return rate [Hz]."""
    intervals = 1e-9 * np.diff(stamps)
    reach = min(9, len(intervals))  # stamps may come in batches
    period = float(np.median(stamps[reach:] - stamps[:-reach])) * 1e-9 / reach
    rate, beside = 1.0 / period, np.pad(intervals, 1, constant_values=period)
    gap = (intervals > 1.8 * period) & (beside[:-2] + intervals + beside[2:] > 3.5 * period)
    jitter, gaps = float(intervals[~gap].std() / period) if not gap.all() else np.nan, intervals[gap]
    report.figures[f"{about} rate_hz"] = rate
    slow = rate < (1.0 - RATE_TOLERANCE) * recommended
    wrong = nominal is not None and not 0.8 < rate / nominal < 1.25
    report.add(f"{about} rate",
               f"{rate:.1f} Hz over {1e-9 * (stamps[-1] - stamps[0]):.1f} s" + (f", {nominal:g} Hz in the sensor file" if wrong else "") +
               (f": at least {recommended:g} Hz are recommended" if slow else "") +
               (": stamps are not in nanoseconds" if rate > RATE_MAX else ""),
               warning=slow or wrong, fails=not (1.0 - RATE_TOLERANCE) * minimum <= rate <= RATE_MAX)
    report.add(f"{about} jitter",
               f"{1e3 * jitter * period:.2f} ms (1 sigma), {100 * jitter:.0f} % of the period" +
               (": stamps are taken on arrival, or in batches; stamp where the sensor is sampled" if jitter > 0.1 else ""),
               warning=jitter > 0.1)
    if len(gaps):
        lost = round(float((gaps / period - 1.0).sum()))
        share = 100 * lost / (len(stamps) + lost)
        report.add(f"{about} gaps", f"{len(gaps)}, the longest {1e3 * gaps.max():.0f} ms; {lost} missing ({share:.1f} %)", warning=True)
    return rate


def check_imu(report: Report, stamps: np.ndarray, imu: np.ndarray, sensor: ImuSensor | None) -> None:
    order, shared = np.diff(stamps) > 0, float(np.mean(np.diff(stamps) == 0))
    if not order.all():
        report.add("imu stamps", f"{int((~order).sum())} of {len(stamps)} are not newer than the one before", warning=True)
        keep = np.concatenate([[True], stamps[1:] > np.maximum.accumulate(stamps)[:-1]])
        stamps, imu = stamps[keep], imu[keep]
    if len(stamps) < 3:
        report.add("imu stamps", "all are the same: the driver does not stamp", fails=True)
        return
    rate = check_rate(report, "imu", stamps, minimum=50.0, recommended=100.0, nominal=sensor.rate if sensor else None)
    if not np.isfinite(imu).all():
        report.add("imu values", "some are not finite", fails=True)
        imu = np.nan_to_num(imu)
    gyro, accel = imu[:, :3], imu[:, 3:]
    force = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.8 < force < 1.2:
        report.add("imu units", f"the specific force is {force:.2f}: in g instead of m/s^2", fails=True)
    elif force < 5.0:
        report.add("imu units", f"the specific force is {force:.2f} m/s^2: gravity has been subtracted, or the vehicle is in free fall", fails=True)
    elif abs(force - GRAVITY) > 1.0:
        report.add("imu units", f"the specific force is {force:.2f} m/s^2 in the median, far from {GRAVITY}", warning=True)
    if np.percentile(np.abs(gyro).max(axis=1), 90) > 35.0:
        report.add("imu units", "a tenth of the angular rates exceed 35 rad/s: they may be in deg/s", fails=True)
    if sensor is not None:
        clipped = (np.abs(gyro) >= 0.99 * sensor.gyro_range).any(axis=1) | (np.abs(accel) >= 0.99 * sensor.accel_range).any(axis=1)
        if clipped.any():
            report.add("imu range", f"{int(clipped.sum())} samples are at the range of the sensor", warning=True)
    rests = [(1e-9 * float(stamps[last - 1] - stamps[first]), first, last) for first, last in stretches_at_rest(stamps, imu)]
    duration, first, last = max(rests, default=(0.0, 0, 0))
    report.figures["still_s"] = duration
    at_start = max((still for still, begin, _ in rests if stamps[begin] - stamps[0] < 0.5e9), default=0.0)
    if duration < 0.5:
        report.add("rest", "never still for half a second: VIO has to start in motion and to estimate the biases meanwhile", warning=True)
        return
    report.add("rest",
               f"still for {duration:.1f} s from {1e-9 * (stamps[first] - stamps[0]):.1f} s on" +
               (f", for {at_start:.1f} s at the start" if at_start < duration else "") +
               (": VIO may have to start in motion" if at_start < 0.5 else ""),
               warning=at_start < 0.5)
    at_edge = round(STILL_WINDOW * rate)  # in the first and the last window a motion may fade out or begin
    first, last = first + at_edge, last - at_edge
    _check_biases(report, gyro[first:last].mean(axis=0), accel[first:last].mean(axis=0), sensor)
    if shared > 0.01:
        report.add("noise", f"not judged: {100 * shared:.0f} % of the samples have the stamp of the one before")
    else:
        _check_noise(report, imu[first:last], rate, sensor)


def _check_biases(report: Report, gyro: np.ndarray, accel: np.ndarray, sensor: ImuSensor | None) -> None:
    """Check the means at rest [rad/s, m/s^2], shape (3,), against the turn-on biases of the sensor file.

    At rest only the accelerometer's bias along gravity can be observed: across it, it looks like a tilt.
    """
    rate, force = float(np.linalg.norm(gyro)), float(np.linalg.norm(accel))
    report.figures |= {"gyro_bias": gyro.tolist(), "force_at_rest": force}
    allowed = BIAS_SIGMAS * sensor.gyro_bias if sensor is not None else np.inf
    more = bool(np.abs(gyro).max() > allowed)
    report.add("gyro bias", f"{rate:.4f} rad/s at rest" + (f": an axis has more than {allowed:.2g}, {BIAS_SIGMAS:g} sigma of the sensor file"
                                                           if more else ""), warning=more or rate > GYRO_BIAS_MAX)
    if sensor is not None:
        allowed = BIAS_SIGMAS * sensor.accel_bias
        more = abs(force - GRAVITY) > allowed
        report.add("accel bias", f"the specific force at rest differs from gravity by {force - GRAVITY:+.3f} m/s^2" +
                   (f": more than {allowed:.2g}, {BIAS_SIGMAS:g} sigma of the sensor file" if more else ""), warning=more)


def check_estimated_biases(report: Report, states: Sequence[InertialState], sensor: ImuSensor) -> None:
    """Check the greatest biases that VIO estimated on an axis against the turn-on biases of the sensor file.

    The estimate of a larger bias than declared is drawn towards zero, and its covariance is too small.
    """
    if not states:
        return
    for name, unit, source in (("gyro_bias", "rad/s", "zero-rate offset"), ("accel_bias", "m/s^2", "zero-g offset")):
        greatest = float(np.abs([getattr(state, name) for state in states]).max())
        sigmas = greatest / getattr(sensor, name)
        report.figures[f"{name}_sigmas"] = sigmas
        more = sigmas > BIAS_SIGMAS
        report.add(f"{name.replace('_', ' ')} of VIO", f"at most {greatest:.2g} {unit} on an axis, {sigmas:.1f} sigma of the sensor file" +
                   (f": declare {name} in the sensor file: the data sheet's {source}, 1 sigma" if more else ""), warning=more)


def _check_noise(report: Report, imu: np.ndarray, rate: float, sensor: ImuSensor | None) -> None:
    """Check the noise densities at rest, from the Allan deviation, against those of the sensor file."""
    if len(imu) < 100:
        return
    tau, deviation = allan_deviation(imu, rate)
    short = tau <= max(0.2, tau[0])  # where white noise dominates
    white = np.median(deviation[short] * np.sqrt(tau[short])[:, None], axis=0)
    gyro, accel = deviation[:, :3].max(axis=1), deviation[:, 3:].max(axis=1)
    densities = {"gyro": float(white[:3].max()), "accel": float(white[3:].max())}
    report.figures |= {"gyro_noise_density": densities["gyro"], "accel_noise_density": densities["accel"], "allan_tau_s": tau.tolist(),
                       "allan_gyro": gyro.tolist(), "allan_accel": accel.tolist()}
    if tau[-1] >= 5.0:
        report.add("bias stability", f"gyro {gyro.min():.1e} rad/s, accelerometer {accel.min():.1e} m/s^2 (least Allan deviation)")
    for name, unit in (("gyro", "rad/s/sqrt(Hz)"), ("accel", "m/s^2/sqrt(Hz)")):
        nominal = getattr(sensor, f"{name}_noise_density") if sensor is not None else np.inf
        more = densities[name] > 2.0 * nominal
        report.add(f"{name} noise", f"{densities[name]:.1e} {unit} at rest" + (f", {nominal:.1e} in the sensor file" if sensor is not None else "")
                   + (": the filter will weight the sensor too much" if more else ""), warning=more)


def stretches_at_rest(stamps: np.ndarray, imu: np.ndarray) -> list[tuple[int, int]]:
    """Return the intervals at rest, in order.

    At rest, the mean over a window is constant. Biases of any size and the vibration of idling rotors are tolerated.

    Args:
        stamps: ascending [ns], shape (n,).
        imu: angular rate [rad/s] and specific force [m/s^2], shape (n, 6).

    Returns:
        Index of the first sample of each interval, and of the one after its last.
    """
    edges = np.searchsorted(stamps, np.arange(stamps[0], stamps[-1], round(STILL_WINDOW * 1e9)))
    parts = [imu[a:b] for a, b in zip(edges[:-1], edges[1:])]
    if len(parts) < 2:
        return []
    limit, shaking = np.repeat(STILL_MEAN, 3), np.repeat(STILL_SIGMA, 3)
    quiet = np.array([len(part) > 3 and bool((part.std(axis=0) < shaking).all()) for part in parts])
    means = np.array([part.mean(axis=0) if len(part) else np.full(6, np.nan) for part in parts])
    found, begin, total = [], 0, np.zeros(6)  # sum of the means from `begin` on
    for k in range(len(parts) + 1):
        same = k < len(parts) and quiet[k] and (k == begin or bool((np.abs(means[k] - total / (k - begin)) < limit).all()))
        if not same:
            if k > begin:
                found.append((int(edges[begin]), int(edges[k])))
            begin, total = (k if k < len(parts) and quiet[k] else k + 1), np.zeros(6)
        if begin <= k < len(parts):
            total = total + means[k]
    return found


def allan_deviation(samples: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Overlapping Allan deviation, sigma^2(tau) = 1/2 <(mean_{k+1} - mean_k)^2> over neighbouring means of length tau.

    Args:
        samples: shape (n, m).
        rate: [Hz].

    Returns:
        tau [s], shape (k,), and the deviations, shape (k, m); tau doubles, up to a fifth of the samples.
    """
    total = np.vstack([np.zeros(samples.shape[1]), np.cumsum(samples, axis=0)])
    lengths = [1 << k for k in range(32) if 5 * (1 << k) <= len(samples)]
    out = []
    for m in lengths:
        means = (total[m:] - total[:-m]) / m
        out.append(np.sqrt(0.5 * np.mean((means[m:] - means[:-m])**2, axis=0)))
    return np.array(lengths) / rate, np.array(out)
