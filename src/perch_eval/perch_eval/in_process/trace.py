"""What a flight leaves behind: plain arrays, no ROS."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from perch_msgs.msg import PowerlineArray

from perch_control.mission import Target
from perch_core.surface import PerchSurface
from perch_eval.in_process.piloting import FlownTrajectory
from perch_eval.in_process.stamps import seconds
from perch_perception.ukf import Status, VioPose
from perch_sim.contact_event import ContactEvent

TRUTH, ESTIMATE = slice(0, 13), slice(13, 26)  # p (3), q (4), v in W (3), w in B (3)


@dataclass
class FlightTrace:
    """One flight; times in seconds, states as p, q (xyzw), v in W, w in B.

    Attributes:
        outcome: `perched`, or the lower-case name of the mission's result; `timeout` past the time limit.
        message: the mission's words.
        end_time: when the goal ended [s].
        wall_time: what it took [s].
        stamps: of every step [ns].
        states: truth and estimate of every step, 26 numbers each.
        motors: armed and rotor speed commands of every step, 5 numbers each [rad/s].
        references: time [s], p, q, v, w, wanted thrust [N], whenever `controller/reference` is published.
        rotors: time [s], speeds (4) [rad/s], thrusts (4) [N], every 5th step.
        contacts: what the vehicle touched.
        trajectories: (time of publication [s], trajectory) in order.
        commands: (time [s], code, reason) of the mission's commands.
        targets: (time from which it counts [s], target).
        maps: (time from which it counts [s], map of powerlines).
        vio: poses in the order they counted.
        pad: the true pad at the end.
        phases: (time [s], phase, message) of the mission.
        estimator: (time [s], status) at 10 Hz.
        covariances: (time [s], pose covariance (6, 6)) at 50 Hz.
    """

    pad: PerchSurface
    outcome: str = "failed"
    message: str = ""
    end_time: float = float("nan")
    wall_time: float = float("nan")
    stamps: list[int] = field(default_factory=list)
    states: list[tuple[float, ...]] = field(default_factory=list)
    motors: list[tuple[float, ...]] = field(default_factory=list)
    references: list[tuple[float, ...]] = field(default_factory=list)
    rotors: list[tuple[float, ...]] = field(default_factory=list)
    contacts: list[ContactEvent] = field(default_factory=list)
    trajectories: list[tuple[float, FlownTrajectory]] = field(default_factory=list)
    commands: list[tuple[float, int, str]] = field(default_factory=list)
    targets: list[tuple[float, Target]] = field(default_factory=list)
    maps: list[tuple[float, PowerlineArray]] = field(default_factory=list)
    vio: list[tuple[float, VioPose]] = field(default_factory=list)
    phases: list[tuple[float, str, str]] = field(default_factory=list)
    estimator: list[tuple[float, Status]] = field(default_factory=list)
    covariances: list[tuple[float, np.ndarray]] = field(default_factory=list)

    @property
    def times(self) -> np.ndarray:
        """Time of every step [s], shape (n,)."""
        return seconds(np.array(self.stamps, dtype=np.int64))

    def part(self, which: slice) -> np.ndarray:
        """`TRUTH` or `ESTIMATE` of every step, shape (n, 13)."""
        return np.array(self.states).reshape(-1, 26)[:, which]
