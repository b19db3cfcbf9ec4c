"""Component that publishes the vehicle's shape and frames: `robot_description`, `/tf_static` and `/tf`."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from perch_core.arrays import Numbers, Quaternion, Vector3, quaternion, vector3
from perch_core.component import Component, Input, Output, Timer
from perch_core.config import text
from perch_core.static_transforms import BASE
from perch_core.urdf import fixed_frames, urdf
from perch_core.values import NANOSECONDS, OdometryState, StampedTransform, TargetPose, Transform
from perch_core.vehicle import load_vehicle

PERIOD = NANOSECONDS // 50  # of the transforms of base_link, by the odometry's stamps [ns]
MAP, ODOM, TARGET = "map", "odom", "perch_target"
_ORIGIN, _IDENTITY_Q = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class DescriptionParameters:
    """Parameters of the node `description`."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")


class Description(Component[DescriptionParameters]):
    """Publishes the vehicle's shape and fixed frames once, and the estimated poses of the vehicle and its target as they change.

    `map` and `odom` coincide: the estimate in `odometry` refers to one frame, and no later correction is applied to it.
    """

    config_type = DescriptionParameters

    odometry = Input(OdometryState, "odometry", lazy=True)
    target = Input(TargetPose, "target/pose", lazy=True)
    start = Timer(0.1)
    robot_description = Output(str, "robot_description")
    static = Output(Transform, "/tf_static")
    frames = Output(StampedTransform, "/tf")

    def __init__(self, config: DescriptionParameters) -> None:
        super().__init__(config)
        self._vehicle = load_vehicle(config.vehicle)
        self._next_stamp = self._ahead_stamp = -1
        self._target: tuple[Vector3, Quaternion] | None = None
        self._published = False

    def on_start(self, now: int) -> None:
        """Publish the constant outputs once, at the first call."""
        if self._published:
            return
        self._published = True
        self.robot_description(urdf(self._vehicle))
        self.static(Transform(MAP, ODOM, _ORIGIN, _IDENTITY_Q))
        for frame in fixed_frames(self._vehicle):
            self.static(frame)

    def on_odometry(self, state: OdometryState) -> None:
        """Publish the pose of the body in `odom`, at most every `PERIOD`."""
        if self._next_stamp - PERIOD <= state.stamp < self._next_stamp:
            return
        if state.frame not in (MAP, ODOM):
            self.warn(f"odometry in frame {state.frame!r} is not used: neither {MAP} nor {ODOM}", min_interval=1.0)
            return
        if self._next_stamp >= 0 and state.stamp > self._next_stamp + NANOSECONDS and not 0 < state.stamp - self._ahead_stamp < NANOSECONDS:
            self._ahead_stamp = state.stamp  # readers of /tf ignore older stamps; two that agree: time has jumped
            self.warn(f"odometry: stamp {state.stamp} ns is ahead of the others: ignored", min_interval=1.0)
            return
        late = 0 <= self._next_stamp <= state.stamp < self._next_stamp + PERIOD
        self._next_stamp = (self._next_stamp if late else state.stamp) + PERIOD
        self.frames(StampedTransform(state.stamp, ODOM, BASE, vector3(state.p_WB), _unit(state.q_WB)))

    def on_target(self, pose: TargetPose) -> None:
        """Publish the pose of the target whenever its estimate changes."""
        if self._next_stamp >= 0 and pose.stamp > self._next_stamp + NANOSECONDS:
            self.warn(f"target/pose: stamp {pose.stamp} ns is ahead of the odometry: ignored", min_interval=1.0)
            return
        p, q = vector3(pose.p_WS), _unit(pose.q_WS)
        if (p, q) != self._target:
            self._target = p, q
            self.frames(StampedTransform(pose.stamp, MAP, TARGET, p, q))


def _unit(q: Numbers) -> Quaternion:
    """Return a quaternion normalised, unchanged where its norm is 1 within 1e-9."""
    norm = hypot(*q)
    return quaternion([float(x) / norm for x in q] if abs(norm - 1.0) > 1e-9 else q)
