"""Responses of an inner loop to its commands: measured, modelled and plotted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp

import numpy as np
from matplotlib.figure import Figure

from perch_core.vehicle import Vehicle
from perch_eval.flight import Flight
from perch_eval.flight_view import ESTIMATE, TRUTH, WANTED
from perch_eval.metrics import perch_window


@dataclass(frozen=True)
class Answer:
    """Command and response over time, for plots: t [s], command, measured and modelled response, each (n,), in `unit`."""

    title: str
    unit: str
    t: np.ndarray
    command: np.ndarray
    measured: np.ndarray
    model: np.ndarray

    @property
    def explained(self) -> float:
        """Share of the measured variance that the model explains, without the noise between neighbouring samples."""
        error, noise = self.measured - self.model, 0.5 * float(np.mean(np.diff(self.measured) ** 2))
        return 1.0 - max(float(np.var(error)) - noise, 0.0) / max(float(np.var(self.measured)) - noise, 1e-12)


def lagged(u: np.ndarray, lag: float, period: float) -> np.ndarray:
    """Return the response of a settled first-order lag to commands (n, ...), with the mean of two samples between them."""
    from scipy.signal import lfilter  # 0.3 s of imports, which a report without an inner loop does without

    fade = exp(-period / max(lag, 1e-6))
    half = 0.5 * (1.0 - fade)
    return lfilter([half, half], [1.0, -fade], u, axis=0, zi=(1.0 - half) * u[:1])[0]


def answers_figure(answers: Sequence[Answer], names: Sequence[str] = ()) -> Figure:
    """Plot one row per response: command, measurement and model over time, and beside it measurement over model.

    Args:
        answers: responses to plot.
        names: labels of the models; by default the share of the measured variance that each explains.
    """
    figure = Figure(figsize=(13, 2.8 * len(answers)), layout="constrained")
    axes = figure.subplots(len(answers), 2, squeeze=False, gridspec_kw={"width_ratios": [4, 1]})
    for k, ((left, right), answer) in enumerate(zip(axes, answers)):
        label = names[k] if names else f"model, explains {100 * answer.explained:.1f} %"
        left.plot(answer.t, answer.measured, color=TRUTH, lw=0.6, label="measured")
        left.plot(answer.t, answer.command, color=WANTED, lw=0.8, label="commanded")
        left.plot(answer.t, answer.model, color=ESTIMATE, lw=1.0, ls="--", label=label)
        left.set_ylabel(f"{answer.title} [{answer.unit}]")
        left.legend(loc="upper right", fontsize=7)
        right.plot(answer.model, answer.measured, ".", ms=1.5, color=TRUTH)
        ends = np.array([answer.model.min(), answer.model.max()])
        right.plot(ends, ends, color=ESTIMATE, lw=1.0)
        right.set(xlabel=f"model [{answer.unit}]", ylabel="measured")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def inner_loop_figure(flight: Flight, vehicle: Vehicle) -> Figure | None:
    """Plot commanded rates and thrust during the perch, the IMU's measurements, and the response by the vehicle file's model.

    Returns:
        The figure; None if the flight has no rate commands, IMU samples or perch.
    """
    sent = [(t, c) for t, c in flight.values("rates_thrust_command") if c.armed]
    imu, window = flight.values("imu/data_raw"), perch_window(flight)
    if len(sent) < 2 or len(imu) < 2 or window is None:
        return None
    a, command_t, t = vehicle.actuation, np.array([time for time, _ in sent]), np.array([time for time, _ in imu])
    command = np.array([(*np.degrees(c.w_B), c.thrust) for _, c in sent])
    measured = np.array([(*np.degrees(sample.w_B), sample.f_B[2]) for _, sample in imu])
    period, shown = float(np.median(np.diff(t))), (t >= window[0] - 0.5) & (t <= window[1])
    rows = [(f"rate {'xyz'[i]}", "deg/s", a.rate_gain[i], a.rate_lag[i]) for i in range(3)]
    answers, names = [], []
    for i, (title, unit, gain, lag) in enumerate([*rows, ("thrust / mass", "m/s^2", a.thrust_gain, a.thrust_lag)]):
        model = lagged(gain * np.interp(t - a.delay - period, command_t, command[:, i]), lag, period)
        answers.append(Answer(title, unit, t[shown], np.interp(t[shown], command_t, command[:, i]), measured[shown, i], model[shown]))
        names.append(f"model: gain {gain:.3f}, lag {1e3 * lag:.0f} ms, delay {1e3 * a.delay:.0f} ms")
    return answers_figure(answers, names)
