"""Node `estimator`: IMU and VIO in, odometry at every IMU step out."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from perch_core import so3
from perch_core.ros import qos
from perch_core.ros.composition import composition
from perch_core.ros.conversions import nanoseconds, odometry_arrays, quaternion_array, to_array, to_stamp, to_vector
from perch_core.ros.deadlines import Deadlines, durations_us
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.wire import OdometryTemplate, read_imu
from perch_msgs.msg import EstimatorStatus, VioState
from sensor_msgs.msg import Imu

from perch_perception.ukf import Estimator, ImuSample, Inertial, UkfConfig, VioPose
from perch_perception.ukf.odometry import covariances, vio_pose, vio_state

STATUS_PERIOD = 50       # steps: 10 Hz
DIAGNOSTICS_PERIOD = 500  # steps: 1 Hz
STATES_LAST = 1_000_000_000  # time after VIO's last whole state in which its odometry is not asked [ns]
DIAGNOSTICS_PHASE = 167  # not with the status, nor with the controller's diagnostics


class EstimatorNode(PerchNode[UkfConfig]):
    """Publishes `odometry` with the stamp of each `imu/data_raw`, within the same lockstep step."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("estimator", UkfConfig, **kwargs)
        self._estimator = Estimator(self.params)
        self._steps = 0
        self._covariance_step = -self.params.covariance_stride
        self._step_costs: deque[float] = deque(maxlen=DIAGNOSTICS_PERIOD)
        self._update_costs: deque[float] = deque(maxlen=60)
        self._deadlines = Deadlines()
        self._unused_vio: list[Odometry | VioState] = []
        self._newest_state = -STATES_LAST  # stamp of VIO's last whole state that was used [ns]
        self._updating = False  # a part of an update waits for spare time
        odometry = Odometry(child_frame_id="base_link")
        odometry.header.frame_id = "map"
        self._odometry = OdometryTemplate(odometry)
        self._odometry_publisher = composition.publisher(self, Odometry, "odometry", qos.CHAIN)
        self._status_publisher = self.create_publisher(EstimatorStatus, "estimator/status", qos.CHAIN)
        self._participant = Participant(self)
        for kind, topic in ((VioState, "vio/state"), (Odometry, "vio/odometry")):
            self._participant.subscribe(kind, topic, self._unused_vio.append)
        self._participant.chain(Imu, "imu/data_raw", self._receive_imu, raw=True, backlog=True)

    def _use_vio(self) -> None:
        """Use the oldest message of VIO. Who gives its whole state is not asked for its odometry."""
        self._unused_vio.sort(key=lambda m: (nanoseconds(m.header.stamp), isinstance(m, Odometry)))
        msg = self._unused_vio.pop(0)
        if isinstance(msg, Odometry) and nanoseconds(msg.header.stamp) <= self._newest_state + STATES_LAST:
            return
        begin = time.perf_counter()
        pose = _state(msg) if isinstance(msg, VioState) else _pose(msg)
        outcome = self._estimator.add_vio(pose, at_once=self._participant.lockstep is not False)
        if outcome.used and pose.inertial is not None:
            self._newest_state = pose.stamp
        self._update_costs.append(0.0)
        self._worked_on_update(begin)

    def _worked_on_update(self, begin: float) -> None:
        """An update or a part of it is done; after the last one the next message brings a new covariance."""
        if not self._estimator.behind:
            self._covariance_step = self._steps - self.params.covariance_stride
        self._update_costs[-1] += time.perf_counter() - begin

    def _receive_imu(self, data: bytes) -> None:
        """In real time an update with VIO, which takes half a period, waits for a step that leaves time for it, and so does each of
        its further parts."""
        while self._unused_vio and self._participant.lockstep is not False:
            self._use_vio()
        sample = ImuSample(*read_imu(data))
        begin = time.perf_counter()
        outcome = self._estimator.add_imu(sample)
        self._step_costs.append(time.perf_counter() - begin)
        if not outcome.used and self._estimator.estimate is None:
            return
        # a sample that was refused still gets its answer: the controller waits for this stamp
        self._publish(sample.stamp)
        if self._steps % STATUS_PERIOD == 0:
            self._participant.later(lambda: self._publish_status(sample.stamp))
        if self._steps % DIAGNOSTICS_PERIOD == DIAGNOSTICS_PHASE:
            self._participant.in_spare_time(lambda: self._publish_costs(sample.stamp * 1e-9))
        self._steps += 1
        if not self._updating and (self._estimator.behind or self._unused_vio):
            self._updating = True
            self._participant.in_spare_time(self._update)

    def _update(self) -> None:
        """In real time: the next part of an update, or the first of the next one."""
        self._updating = False
        if self._estimator.behind:
            begin = time.perf_counter()
            self._estimator.go_on()
            self._worked_on_update(begin)
        else:
            self._use_vio()

    def _publish(self, stamp: int) -> None:
        estimate = self._estimator.estimate
        if self._steps - self._covariance_step >= self.params.covariance_stride:
            R_WB = so3.quat_to_matrix(estimate.q_WB)
            self._odometry.covariances(*covariances(R_WB, estimate.v_WB, estimate.P, self.params.imu.gyro_noise))
            self._covariance_step = self._steps
        state = (x.tolist() for x in (estimate.p_WB, estimate.q_WB, estimate.v_WB, estimate.w_WB_B))
        self._odometry_publisher.publish(self._odometry.fill(stamp, *state))
        if self._participant.lockstep is False:
            self._deadlines.answered(stamp, time.monotonic_ns())

    def _publish_status(self, stamp: int) -> None:
        status, estimate = self._estimator.status, self._estimator.estimate
        msg = EstimatorStatus(
            state=status.health.value, vio_age=float(status.vio_age), updates_accepted=status.accepted,
            updates_rejected=status.rejected, nis=float(status.nis), gyro_bias=to_vector(estimate.gyro_bias),
            accel_bias=to_vector(estimate.accel_bias), position_sigma=float(status.position_sigma),
            attitude_sigma=float(status.attitude_sigma), message=status.message)
        msg.header.stamp, msg.header.frame_id = to_stamp(stamp), "map"
        self._status_publisher.publish(msg)

    def _publish_costs(self, now: float) -> None:
        """Cost per step and update of the last second on /diagnostics."""
        status = self._estimator.status
        values: dict[str, Any] = {"state": status.health.name, "vio_age_s": status.vio_age,
                                  "updates_accepted": status.accepted, "updates_rejected": status.rejected}
        values |= durations_us("imu_step", self._step_costs) | durations_us("vio_update", self._update_costs)
        if self._participant.lockstep is False:
            values |= self._deadlines.report()
        level = 0 if status.health.name == "RUNNING" else 2 if status.health.name == "DIVERGED" else 1
        self.publish_diagnostics(now, values, level, status.message)


def _pose(msg: Odometry) -> VioPose:
    p, q, v, _ = odometry_arrays(msg)
    covariance = np.array(msg.pose.covariance).reshape(6, 6)
    twist = np.array(msg.twist.covariance).reshape(6, 6)
    v = v if twist[0, 0] >= 0 else None  # -1: no velocity in this message
    velocity_covariance_B = twist[:3, :3] if twist[0, 0] > 0 else None  # all zero: not given
    return vio_pose(nanoseconds(msg.header.stamp), p, q, covariance, v, velocity_covariance_B)


def _state(msg: VioState) -> VioPose:
    inertial = Inertial(to_array(msg.gyro_bias), to_array(msg.accel_bias), np.array(msg.covariance).reshape(15, 15))
    return vio_state(nanoseconds(msg.header.stamp), to_array(msg.position), quaternion_array(msg.orientation), to_array(msg.velocity),
                     inertial)


def create(**kwargs: Any) -> EstimatorNode:
    """The node, for its own process or a composed one."""
    return EstimatorNode(**kwargs)


def main() -> None:
    """Entry point of the executable `estimator`."""
    spin_main(create)
