"""Consistency of VIO, estimator and target in the flights of the evaluation: NEES and NIS with their bounds.

Times are relative to the planned start of the perch, so that flights can be averaged. Only samples in the air count: on the ground
the position is known exactly, and no useful covariance is that small.

VIO's covariance contains that of its start pose, but the simulated vehicle starts exactly where it is told: the errors of position and
heading at the start are drawn, and move the map relative to the true world. Nothing that is measured depends on where the map is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from perch_core import config, so3
from perch_core.extends import extended_mapping
from perch_core.values import OdometryState, TargetPose, seconds
from perch_eval import consistency
from perch_eval.campaign.causes import SUCCESS, cause_of
from perch_eval.campaign.engines import Task, run_task
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Run
from perch_eval.campaign.workers import failed_run
from perch_eval.evaluation.kept import cached_figures
from perch_eval.evaluation.document import Effort, Section
from perch_eval.flight import Flight, States
from perch_eval.in_process import Loop, Sensing, arrange
from perch_eval.in_process.flights import perch
from perch_eval.metrics import figures, flight_metrics, perch_window
from perch_perception.ukf import Estimate
from perch_perception.vio.start import CONFIGURED_POSE_SIGMA
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario

SCENARIO = "surface_90"
SENSING = Sensing(vio="rendered", target="rendered")
STATES = "estimator: all 15 states"
REQUIRED_SHARE = 0.85  # of the time inside the bounds
FULL = range(1, 201)  # seeds with --full: the more runs, the narrower the bounds that the requirement is about
GROUPS = {STATES: slice(0, 15), "estimator: position": slice(0, 3), "estimator: velocity": slice(3, 6),
          "estimator: attitude": slice(6, 9)}
VIO_GROUPS = {"vio: pose": slice(0, 6)}
TARGET_GROUPS = {"target: pose": slice(0, 6), "target: position": slice(0, 3), "target: attitude": slice(3, 6)}
RMSE = tuple(f"estimation_rmse_m_{axis}" for axis in "xyz")
NIS = {"nis_estimator": "the estimator", "nis_vio": "VIO"}
DIMENSIONS = {name: part.stop - part.start for name, part in (GROUPS | VIO_GROUPS | TARGET_GROUPS).items()}
TIMES = np.arange(-90, 60) / 30  # relative to the planned start of the perch [s]
NEAREST = 1 / 59  # a time has the sample that is nearest to it, if it is as near as this [s]: half a period of the cameras
AIRBORNE_AFTER = 0.4  # from the end of the contact with the ground until the vehicle is clear of it [s]
STRIDE_NS = 10_000_000  # between states of the estimator that are kept


@dataclass(frozen=True)
class JudgedRun(RunResult):
    """Result of one flight; `history`: NEES of each part at `TIMES`, None where it is not judged."""

    history: dict[str, list[float | None]] = field(default_factory=dict)


def consistency_sections(effort: Effort) -> list[Section]:
    """Return NEES of estimator, VIO and target over time with its figure, RMSE during the perch, and mean NIS."""
    seeds = FULL if effort.full else effort.seeds
    flights = judged_flights(effort, seeds)
    flown = [(run, judged) for run, judged in flights if judged]
    out = Section("c_consistency", "Consistency of the estimators",
                  f"`{SCENARIO}` with both cameras rendered, seeds {seeds.start} to {seeds.stop - 1}, the flights of Table III among them; from "
                  f"{AIRBORNE_AFTER:g} s after take-off to the contact, by the time from the planned start of the perch, where at least half of the "
                  f"flights are in the air; {len(flown)} of {len(flights)} flights planned one. "
                  "Errors of VIO's start are drawn as declared (1 mm, 1 mrad). NEES per dimension, averaged over the flight; the share of the time "
                  "in which the mean over the runs is inside its 95 % bounds, and above them (overconfident).")
    if not flown:
        out.missing(STATES, "", "no flight planned a perch")
        return [out]
    results = [consistency.judge(name, TIMES, np.array([judged[name] for _, judged in flown], float), dimension)
               for name, dimension in DIMENSIONS.items()]
    for name in (r.name for r in results if not len(r.times)):
        out.missing(name, "", "at no time do half of the flights have a sample")
    results = [r for r in results if len(r.times)]
    for r in results:
        words = f"{r.mean.mean() / r.dimension:.2f}; {100 * r.inside:.0f} % inside, {100 * r.above:.0f} % above"
        if r.name == STATES:
            out.claim(r.name, words, "", r.inside >= REQUIRED_SHARE, f"inside for at least {100 * REQUIRED_SHARE:.0f} % of the time")
            out.show("estimator: all 15 states, single samples", f"{100 * r.samples_inside:.0f} % inside",
                     note="share of the samples of all flights inside the 95 % bounds of one sample")
        else:
            out.show(r.name, words)
        out.data[r.name] = {"inside": r.inside, "above": r.above, "mean_over_dimension": float(r.mean.mean() / r.dimension),
                            "samples_inside": r.samples_inside}
    metrics = {name: np.array([run.metrics.get(name) for run, _ in flown], float) for name in (*RMSE, *NIS)}
    rmse = ", ".join(f"{100 * np.nanmedian(metrics[name]):.2f}" for name in RMSE)
    out.show("RMSE of x, y, z through the perch", f"{rmse} cm", note="median")
    for name, title in NIS.items():
        out.show(f"NIS of {title} over its dimension", f"{np.nanmean(metrics[name]):.2f}", note="mean over the flights")
    if results:
        consistency.plot(results, effort.out / "consistency.png", {"perch": 0.0})
        out.figures.append(("consistency.png", "NEES, mean over the runs, with its expectation and its 95 % bounds"))
    return [out]


def judged_flights(effort: Effort, seeds: Sequence[int]) -> list[tuple[RunResult, dict[str, list[float | None]]]]:
    """Return result and history of the flight of each seed; finished flights of the same code are not repeated."""
    rows = cached_figures(effort, "judged_perches", seeds, _fly_seed, lambda row: row["cause"] == SUCCESS,
                          on_worker_death=lambda seed: asdict(failed_run(_task(seed))))
    return [(RunResult(**{name: value for name, value in row.items() if name != "history"}), row.get("history", {})) for row in rows]


def _task(seed: int) -> Task:
    return Task(Run(seed, seed, {"scenario": SCENARIO}), extended_mapping("scenarios", SCENARIO), f"{__name__}:fly_judged", SENSING)


def _fly_seed(seed: int) -> dict[str, Any]:
    return asdict(run_task(_task(seed)))


def fly_judged(task: Task) -> JudgedRun:
    """Fly a run as the engine `in_process` does, and compare the estimates with the truth."""
    scenario = config.from_mapping(Scenario, task.scenario, SCENARIO)
    loop = arrange(scenario, task.run.seed, task.sensing)
    watched = _Watched(loop)
    trace = perch(loop, scenario)
    metrics = figures(flight_metrics(trace.flight, trace.end_time), trace.end_time) | watched.nis
    return JudgedRun(task.run.number, task.run.seed, cause_of(trace.outcome, trace.contacts, scenario), trace.outcome, trace.message,
                     metrics=metrics, history=history(trace.flight, watched.states, watched.biases, start_error(task.run.seed)))


class _Watched:
    """What the channels of a flight in progress do not carry.

    Attributes:
        states: states of the estimator, one per `STRIDE_NS`.
        biases: true biases of gyro and accelerometer at these states, shape (6,) each.
    """

    def __init__(self, loop: Loop) -> None:
        self.states: list[Estimate] = []
        self.biases: list[np.ndarray] = []
        self._estimator, self._vio, self._imu = loop.components["estimator"], loop.components["vio"], loop.vehicle.simulation.imu
        self._accepted, self._sums = 0, {"estimator": np.zeros(2), "vio": np.zeros(2)}  # NIS and its dimension
        self._estimator.odometry.receivers.append(self._on_odometry)
        self._vio.odometry.receivers.append(self._on_vio)

    @property
    def nis(self) -> dict[str, float | None]:
        """NIS of estimator and VIO over its dimension, over the whole flight."""
        return {f"nis_{name}": nis / dimension if dimension else None for name, (nis, dimension) in self._sums.items()}

    def _on_odometry(self, odometry: Any) -> None:
        status = self._estimator.filter.status
        if status.accepted > self._accepted:
            self._sums["estimator"] += status.nis, status.nis_dimension
        self._accepted = status.accepted
        if odometry.stamp % STRIDE_NS == 0:
            self.states.append(self._estimator.filter.estimate)
            self.biases.append(np.roll(self._imu.bias, 3))

    def _on_vio(self, _: Any) -> None:
        self._sums["vio"] += self._vio.result.nis, self._vio.result.nis_dimension


def start_error(seed: int) -> np.ndarray:
    """Return the error of VIO's start, truth relative to the map: position [m] and heading [rad], shape (4,)."""
    return np.random.default_rng([seed, 9]).standard_normal(4) * CONFIGURED_POSE_SIGMA


def history(flight: Flight, states: Sequence[Estimate], biases: Sequence[np.ndarray], start: np.ndarray) -> dict[str, list[float | None]]:
    """Return the NEES of each part at `TIMES`, of a flight with a planned perch; without one, nothing.

    Args:
        flight: the flight.
        states: states of the estimator.
        biases: true biases of gyro and accelerometer at these states, shape (6,) each.
        start: from `start_error`.
    """
    window = perch_window(flight)
    if window is None or not states:
        return {}
    clear = min((t for t, contact in flight.values("contact") if contact.state == ContactState.NONE), default=window[0]) + AIRBORNE_AFTER
    at, out, truth = window[0] + TIMES, {}, _truth_in_map(flight, start)
    for groups, (times, errors, covariances) in ((GROUPS, _estimator_errors(truth, states, biases)), (VIO_GROUPS, _vio_errors(flight, truth)),
                                                 (TARGET_GROUPS, _target_errors(flight))):
        nearest = np.abs(times[:, None] - at).argmin(axis=0)
        judged = (np.abs(times[nearest] - at) <= NEAREST) & (at > clear) & (at < window[1])
        for name, part in groups.items():
            values = consistency.nees(errors[:, part], covariances[:, part, part])[nearest]
            out[name] = [round(float(value), 4) if use else None for value, use in zip(values, judged)]
    return out


Errors = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Times [s], shape (m,), errors, truth relative to the estimate, shape (m, n), and covariances, shape (m, n, n)."""


def _truth_in_map(flight: Flight, start: np.ndarray) -> States:
    """Return the true states relative to the map: turned about the vehicle's start, and moved, by the errors `start`."""
    true, turn = flight.known_states("ground_truth/odometry"), np.array([0.0, 0.0, start[3]])
    R = so3.exp(turn)
    return replace(true, p=true.p[0] + start[:3] + (true.p - true.p[0]) @ R.T, q=so3.quat_multiply(so3.quat_exp(turn), true.q), v=true.v @ R.T)


def _estimator_errors(truth: States, states: Sequence[Estimate], biases: Sequence[np.ndarray]) -> Errors:
    """Of (p, v, theta, b_g, b_a), theta in B."""
    times = np.array([seconds(e.stamp) for e in states])
    true = truth.at(times)
    p, v, q, b_g, b_a = (np.array([getattr(e, name) for e in states]) for name in ("p_WB", "v_WB", "q_WB", "gyro_bias", "accel_bias"))
    errors = [true.p - p, true.v - v, consistency.attitude_error(true.q, q), np.array(biases) - np.hstack([b_g, b_a])]
    return times, np.hstack(errors), np.array([e.P for e in states])


def _vio_errors(flight: Flight, truth: States) -> Errors:
    """Of VIO's (position, rotation), in the axes of W."""
    found: list[OdometryState] = [value for t, value in flight.values("vio/odometry") if truth.t[0] <= t <= truth.t[-1]]
    times = np.array([seconds(value.stamp) for value in found])
    R_true = Slerp(truth.t, Rotation.from_quat(truth.q))(times).as_matrix()  # by interpolation: the exposure is between two states
    turn = so3.log(R_true @ _matrices([value.q_WB for value in found]).swapaxes(1, 2))
    return times, np.hstack([truth.at(times).p - [value.p_WB for value in found], turn]), np.array([value.pose_covariance for value in found])


def _target_errors(flight: Flight) -> Errors:
    """Of the pad's (position, rotation) relative to the vehicle, in the axes of W, as is the covariance of `target/pose`: without `start`."""
    found: list[TargetPose] = [value for _, value in flight.values("target/pose")]
    times, pad = np.array([seconds(value.stamp) for value in found]), flight.values("ground_truth/target")[0][1]
    estimate = flight.known_states("odometry")
    estimate = estimate.chosen(np.clip(np.searchsorted(estimate.t, times), 0, len(estimate.t) - 1))
    true = flight.known_states("ground_truth/odometry").at(estimate.t)
    # where the true vehicle is put where the estimated one is, the true pad is there
    turn = _matrices(estimate.q) @ _matrices(true.q).swapaxes(1, 2)
    p_WS, R_WS = estimate.p + np.einsum("nij,nj->ni", turn, np.array(pad.p) - true.p), turn @ _matrices(pad.q)
    errors = [p_WS - [value.p_WS for value in found], so3.log(R_WS @ _matrices([value.q_WS for value in found]).swapaxes(1, 2))]
    return times, np.hstack(errors), np.array([value.covariance for value in found])


def _matrices(q: Any) -> np.ndarray:
    return so3.quat_to_matrix(np.array(q))
