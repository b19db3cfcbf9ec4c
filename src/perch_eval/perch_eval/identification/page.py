"""What was identified: entries for the vehicle file, and a page of plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from perch_core.vehicle import Vehicle
from perch_eval.flight import Flight
from perch_eval.flight_view import ESTIMATE, TRUTH, WANTED
from perch_eval.identification.fit import Answer, Found, lagged
from perch_eval.metrics import perch_window
from perch_eval.plots import encode


def entries(found: Sequence[Found], vehicle: Vehicle, base: str, name: str, flight: str, voltages: Sequence[float] = ()) -> str:
    """A vehicle file that extends `base` by what was identified; all else stays as it is there, with the reason in a comment.

    Args:
        found: what was identified.
        vehicle: as it was known so far.
        base: its name, or its file.
        name: of the identified vehicle.
        flight: of which it was identified, in words.
        voltages: of the flights [V], the first one that of the thrust curve.
    """
    lines: list[str] = []
    for key in dict.fromkeys(one.key.split("[")[0] for one in found):
        group = [one for one in found if one.key.split("[")[0] == key]
        owner = vehicle.actuation if key.startswith("actuation.") else vehicle
        field = key.split(".")[-1]
        if key == "actuation.battery.exponent" and not group[0].refused:
            text = f"{{reference: {voltages[0]:g}, exponent: {group[0].value:.4g}, range: [{min(voltages):g}, {max(voltages):g}]}}"
            lines.append(f"  battery: {text}  # exponent +- {group[0].sigma:.2g}")
        old = getattr(owner, field, None)
        if old is None:
            continue
        new = [old[i] if one.refused else one.value for i, one in enumerate(group)] if isinstance(old, tuple) else group[0].value
        told = not all(one.refused for one in group)
        axes = [f"{'xyz'[i]} " if len(group) > 1 else "" for i in range(len(group))]
        sigmas = "; ".join(f"{axis}+- {one.sigma:.2g} {one.unit}".rstrip() for axis, one in zip(axes, group) if not one.refused)
        text = f"[{', '.join(f'{x:.4g}' for x in new)}]" if isinstance(new, list) else f"{new:.5g}"
        indent = "  " if key.startswith("actuation.") else ""
        lines += [f"{indent}# {field}: {axis}not identified: {one.refused}" for axis, one in zip(axes, group) if one.refused]
        if told:
            lines.append(f"{indent}{field}: {text}".ljust(45) + f"# {sigmas}")
    mine, inner = [line for line in lines if not line.startswith("  ")], [line for line in lines if line.startswith("  ")]
    head = [f"# Identified by scripts/identify.py, with standard deviations. Of: {flight}", f"extends: {base}", f"name: {name}"]
    return "\n".join([*head, *mine, *(["actuation:", f"  type: {vehicle.actuation.type}", *inner] if inner else [])]) + "\n"


def answers_figure(answers: Sequence[Answer], names: Sequence[str] = ()) -> Figure:
    """One row per answer: command, measured and model over time, and beside it measured over model.

    Args:
        answers: what is drawn.
        names: of the models; by default how much of the measured variance each explains.
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


def draw(file: Path, found: Sequence[Found], answers: Sequence[Answer], title: str) -> None:
    """The answers, and below them what was found."""
    figure = answers_figure([replace(answer, t=answer.t - answer.t[0]) for answer in answers])
    figure.suptitle(title)
    figure.supxlabel("\n".join(map(str, found)), family="monospace", fontsize=8, x=0.02, ha="left")
    figure.savefig(file, dpi=95)


def inner_loop_figure(flight: Flight, vehicle: Vehicle) -> str:
    """Commands of rates and thrust through the perch, what the IMU reads, and the answer of the model that the vehicle file has.

    Returns:
        PNG in base64; empty where the vehicle takes no rates, or the flight has none.
    """
    sent = [(t, c) for t, c in flight.values("rates_thrust_command") if c.armed]
    imu, window = flight.values("imu/data_raw"), perch_window(flight)
    if len(sent) < 2 or len(imu) < 2 or window is None:
        return ""
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
    return encode(answers_figure(answers, names))
