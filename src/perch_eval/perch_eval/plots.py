"""The figures of a flight's report."""

from __future__ import annotations

import base64
import io
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402  (the backend must be chosen first)

from perch_core import so3  # noqa: E402
from perch_core.vehicle import Vehicle  # noqa: E402
from perch_eval.flight import Flight  # noqa: E402
from perch_eval.metrics import perch_window, thrust_history, tilt_degrees, touch_of  # noqa: E402

TRUTH, ESTIMATE, WANTED, LIMIT = "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728"
RUNNING = 1  # state in perch_msgs/EstimatorStatus


def encode(figure: Any) -> str:
    """A figure as PNG in base64, for a page; it fills its size."""
    buffer = io.BytesIO()
    if figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")
    figure.savefig(buffer, format="png", dpi=95)
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def _span(flight: Flight) -> tuple[float, float]:
    window = perch_window(flight)
    if window is not None:
        return window[0] - 0.3, window[1] + 0.7
    truth = flight.states("ground_truth/odometry")
    return float(truth.t[0]), float(truth.t[-1])


def _mark(axis: Any, flight: Flight) -> None:
    """Plan start and contact as vertical lines."""
    window, touch = perch_window(flight), touch_of(flight)
    if window is not None:
        axis.axvline(window[0], color="0.7", lw=0.8)
    if touch is not None:
        axis.axvline(touch[0], color=LIMIT, lw=0.8, ls="--")


def tracking_figure(flight: Flight) -> str:
    """Position over time: reference, truth, estimate (the paper's Fig. 5)."""
    t0, t1 = _span(flight)
    truth, estimate, reference = flight.states("ground_truth/odometry"), flight.states("odometry"), flight.reference()
    figure, axes = plt.subplots(3, 2, figsize=(12, 6.5), sharex=True)
    for i, name in enumerate("xyz"):
        for states, colour, label, style in ((reference, WANTED, "reference", "-"), (truth, TRUTH, "truth", "-"),
                                             (estimate, ESTIMATE, "estimate", "--")):
            if states is None:
                continue
            keep = (states.t >= t0) & (states.t <= t1)
            axes[i, 0].plot(states.t[keep], states.p[keep, i], style, color=colour, label=label, lw=1.4)
            axes[i, 1].plot(states.t[keep], states.v[keep, i], style, color=colour, lw=1.4)
        axes[i, 0].set_ylabel(f"{name} [m]")
        axes[i, 1].set_ylabel(f"v{name} [m/s]")
        for axis in axes[i]:
            axis.grid(alpha=0.3)
            _mark(axis, flight)
    axes[0, 0].legend(loc="best", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    return encode(figure)


def path_figure(flight: Flight) -> str:
    """Side view of the perch with the thrust direction as arrows (the paper's Fig. 5, right)."""
    t0, t1 = _span(flight)
    truth, reference = flight.states("ground_truth/odometry"), flight.reference()
    keep = (truth.t >= t0) & (truth.t <= t1 - 0.4)
    p, q = truth.p[keep], truth.q[keep]
    figure, axis = plt.subplots(figsize=(12, 5))
    target = flight.values("ground_truth/target")
    direction = np.array([1.0, 0.0])
    if target:
        pad = target[-1][1]
        c, R = np.array(pad.p), so3.quat_to_matrix(np.array(pad.q))
        horizontal = np.cross(R[:, 1], [0.0, 0.0, 1.0])[:2]
        if np.linalg.norm(horizontal) > 1e-6:
            direction = horizontal / np.linalg.norm(horizontal)
        ends = np.array([c - 0.3 * R[:, 0], c + 0.3 * R[:, 0]])
        axis.plot(ends[:, :2] @ direction, ends[:, 2], color="k", lw=5, solid_capstyle="butt", label="pad")
    if reference is not None:
        inside = (reference.t >= t0) & (reference.t <= t1 - 0.4)
        axis.plot(reference.p[inside][:, :2] @ direction, reference.p[inside][:, 2], color=WANTED, lw=1.2, label="reference")
    axis.plot(p[:, :2] @ direction, p[:, 2], color=TRUTH, lw=1.5, label="truth")
    b3 = so3.quat_rotate(q, np.array([0.0, 0.0, 1.0]))
    every = slice(None, None, max(1, len(p) // 28))
    axis.quiver(p[every][:, :2] @ direction, p[every][:, 2], b3[every][:, :2] @ direction, b3[every][:, 2],
                color=ESTIMATE, width=0.004, scale=14, label="b3")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("towards the pad [m]")
    axis.set_ylabel("z [m]")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return encode(figure)


def rates_figure(flight: Flight) -> str:
    """Body rates (the paper's Fig. 6) and tilt."""
    t0, t1 = _span(flight)
    truth, reference = flight.states("ground_truth/odometry"), flight.reference()
    figure, axes = plt.subplots(2, 2, figsize=(12, 5), sharex=True)
    for i, (axis, name) in enumerate(zip(axes.flat, "xyz")):
        for states, colour, label in ((reference, WANTED, "commanded"), (truth, TRUTH, "truth")):
            if states is not None:
                keep = (states.t >= t0) & (states.t <= t1)
                axis.plot(states.t[keep], np.degrees(states.w[keep, i]), color=colour, lw=1.3, label=label)
        axis.set_ylabel(f"rate {name} [deg/s]")
    keep = (truth.t >= t0) & (truth.t <= t1)
    axes[1, 1].plot(truth.t[keep], tilt_degrees(truth.q[keep]), color=TRUTH, lw=1.3)
    axes[1, 1].set_ylabel("tilt of b3 [deg]")
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        _mark(axis, flight)
    axes[0, 0].legend(fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    return encode(figure)


def thrust_figure(flight: Flight, vehicle: Vehicle) -> str:
    """Collective thrust against its bounds [M:eq16]."""
    t0, t1 = _span(flight)
    t, reached, commanded = thrust_history(flight, vehicle)
    keep = (t >= t0) & (t <= t1)
    figure, axis = plt.subplots(figsize=(12, 2.8))
    tr, wanted = flight.vectors("controller/reference", lambda r: r.thrust)
    inside = (tr >= t0) & (tr <= t1)
    axis.plot(tr[inside], wanted[inside] if len(tr) else [], color=WANTED, lw=1.2, label="reference")
    axis.plot(t[keep], commanded[keep], color=ESTIMATE, lw=0.9, label="commanded to the rotors (leads the lag)")
    axis.plot(t[keep], reached[keep], color=TRUTH, lw=1.4, label="reached")
    for bound in (4 * vehicle.thrust_min, 4 * vehicle.thrust_max):
        axis.axhline(bound, color=LIMIT, lw=0.8, ls="--")
    axis.set_ylabel("thrust [N]")
    axis.set_xlabel("time [s]")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncol=3)
    _mark(axis, flight)
    return encode(figure)


def error_figure(flight: Flight) -> str:
    """Estimation error with its own 3-sigma bounds over the whole flight."""
    truth, estimate = flight.states("ground_truth/odometry"), flight.states("odometry")
    if estimate is None:
        return ""
    running = [t for t, health in flight.values("estimator/status") if health.state == RUNNING]
    began = running[0] if running else estimate.t[0]  # before, the filter knows nothing: kilometres of sigma
    shown = [(t, state) for t, state in flight.values("odometry") if t >= began][::10]
    keep = estimate.t >= began
    sigma = np.array([np.sqrt(np.maximum(0.0, state.pose_covariance.diagonal()[:3])) for _, state in shown])
    ts = np.array([t for t, _ in shown])
    error = estimate.p - truth.at(estimate.t).p
    figure, axes = plt.subplots(1, 3, figsize=(12, 2.8), sharex=True)
    for i, (axis, name) in enumerate(zip(axes, "xyz")):
        axis.plot(estimate.t[keep], 100 * error[keep, i], color=TRUTH, lw=1.0)
        for sign in (-3, 3):
            axis.plot(ts, sign * 100 * sigma[:, i], color=LIMIT, lw=0.7, ls="--")
        axis.set_ylabel(f"estimate - truth, {name}, with 3 sigma [cm]", fontsize=8)
        axis.set_xlabel("time [s]")
        axis.grid(alpha=0.3)
        _mark(axis, flight)
    return encode(figure)
