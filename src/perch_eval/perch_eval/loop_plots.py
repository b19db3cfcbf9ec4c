"""Plots of a vehicle's inner loop in flight: wanted against flown rates and thrust, and its model as the vehicle file has it."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from perch_core.vehicle import Vehicle
from perch_eval.flight import Flight
from perch_eval.identification.fit import lagged
from perch_eval.metrics import perch_window
from perch_eval.plots import ESTIMATE, TRUTH, WANTED, encode


def inner_loop_figure(flight: Flight, vehicle: Vehicle) -> str:
    """Commands, the answer of the model that the vehicle file has, and what the IMU reads, through the perch; beside it measured over model.

    Empty where the vehicle takes no rates, or the flight has none."""
    sent = [(t, c) for t, c in flight.values("rates_thrust_command") if c.armed]
    imu, window = flight.values("imu/data_raw"), perch_window(flight)
    if len(sent) < 2 or len(imu) < 2 or window is None:
        return ""
    a, command_t, t = vehicle.actuation, np.array([time for time, _ in sent]), np.array([time for time, _ in imu])
    command = np.array([(*np.degrees(c.w_B), c.thrust) for _, c in sent])
    measured = np.array([(*np.degrees(sample.w_B), sample.f_B[2]) for _, sample in imu])
    begin, end = window[0] - 0.5, window[1]
    period = float(np.median(np.diff(t)))
    shown = (t >= begin) & (t <= end)
    figure, axes = plt.subplots(4, 2, figsize=(12, 10), gridspec_kw={"width_ratios": [4, 1]})
    rows = [("rate " + "xyz"[i], "deg/s", a.rate_gain[i], a.rate_lag[i]) for i in range(3)]
    rows.append(("thrust / mass", "m/s^2", a.thrust_gain, a.thrust_lag))
    for i, ((left, right), (name, unit, gain, lag)) in enumerate(zip(axes, rows)):
        model = lagged(gain * np.interp(t - a.delay - period, command_t, command[:, i]), lag, period)
        left.plot(t[shown], measured[shown, i], color=TRUTH, lw=0.9, label="measured")
        left.plot(t[shown], np.interp(t[shown], command_t, command[:, i]), color=WANTED, lw=1.2, label="commanded")
        words = f"model: gain {gain:.3f}, lag {1e3 * lag:.0f} ms, delay {1e3 * a.delay:.0f} ms"
        left.plot(t[shown], model[shown], color=ESTIMATE, lw=1.2, ls="--", label=words)
        left.set_ylabel(f"{name} [{unit}]")
        left.legend(fontsize=8)
        right.plot(model[shown], measured[shown, i], ".", ms=1.5, color=TRUTH)
        ends = np.array([model[shown].min(), model[shown].max()])
        right.plot(ends, ends, color=ESTIMATE, lw=1.0)
        right.set(xlabel=f"model [{unit}]", ylabel="measured")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("time [s]")
    return encode(figure)
