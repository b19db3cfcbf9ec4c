"""Node `vio_model`: a STAND-IN for VIO that degrades the truth with drift, noise and latency. Not an estimator."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo

from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, to_stamp
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.wire import read_odometry
from perch_core.timing import TICK_STEPS
from perch_core.vehicle import load_vehicle
from perch_sim import seeding
from perch_sim.state_history import StateHistory, TrueState
from perch_sim.vio_model import VioModel, VioModelParameters

MEMORY = 200  # true states kept: 0.4 s


class VioModelNode(PerchNode[VioModelParameters]):
    """One `vio/odometry` per frame of the camera, stamped with the middle of its exposure on the IMU's clock.

    It reads `camera_info` instead of images, so that it works with the cameras off.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("vio_model", VioModelParameters, **kwargs)
        try:
            vehicle = load_vehicle(self.params.vehicle)
            if self.params.camera not in vehicle.mounts:
                raise ConfigError("vio_model", "camera", f"{self.params.camera!r} is not one of {', '.join(vehicle.mounts)}")
        except ConfigError:
            self.destroy_node()
            raise
        self._offset = round(vehicle.mounts[self.params.camera].stamp_offset * 1e9)
        self._model = VioModel(self.params, seeding.stream(self.params.seed, "vio_model"))
        self._history = StateHistory(MEMORY)
        self._newest = 0
        self._frames: deque[int] = deque()                        # stamps of frames to be answered
        self._late: deque[tuple[int, Odometry]] = deque()         # real time: (when it counts, answer)
        self._participant = Participant(self, every=TICK_STEPS)
        self._publisher = self._participant.publisher(Odometry, "vio/odometry")
        self.create_subscription(Odometry, "ground_truth/odometry", self._receive_truth, qos.CHAIN, raw=True)
        self.create_subscription(CameraInfo, f"camera_{self.params.camera}/camera_info", self._receive_frame, qos.CHAIN)
        self._participant.greet()
        self.get_logger().warning("vio_model is a stand-in: vio/odometry is the truth with drift and noise")

    def _receive_truth(self, data: bytes) -> None:
        self._newest, p_WB, q_WB, v_WB, w_WB_B = read_odometry(data)
        self._history.append(TrueState(self._newest, np.array((*p_WB, *q_WB, *v_WB, *w_WB_B))))
        self._answer()
        while self._late and self._late[0][0] <= self._newest:
            self._publisher.publish(self._late.popleft()[1])

    def _receive_frame(self, msg: CameraInfo) -> None:
        self._frames.append(nanoseconds(msg.header.stamp))
        self._answer()

    def _answer(self) -> None:
        """Answer every frame whose exposure the truth covers by now."""
        while self._frames and self._frames[0] - self._offset <= self._newest:
            stamp = self._frames.popleft()
            exposed = stamp - self._offset
            try:
                state = self._history.at(exposed)
            except LookupError as error:
                self.get_logger().warning(f"frame without truth: {error}", throttle_duration_sec=1.0)
            else:
                answer = self._message(state)
                if self._participant.lockstep is False:
                    self._late.append((exposed + round(self.params.latency * 1e9), answer))
                else:
                    self._publisher.publish(answer)
            self._participant.report(to_stamp(stamp))

    def _message(self, state: TrueState) -> Odometry:
        estimate = self._model.degrade(state.time * 1e-9, state.p_WB, state.q_WB, state.v_WB)
        msg = Odometry(child_frame_id="base_link")
        msg.header.stamp, msg.header.frame_id = to_stamp(state.time), "odom"
        fill_odometry(msg, estimate.p_WB, estimate.q_WB, estimate.v_WB, state.w_WB_B)
        msg.pose.covariance = np.diag(estimate.pose_variance).ravel()
        msg.twist.covariance = np.diag([estimate.velocity_variance] * 3 + [1e-4] * 3).ravel()
        return msg


def create(**kwargs: Any) -> VioModelNode:
    """The node, alone or composed."""
    return VioModelNode(**kwargs)


def main() -> None:
    """Entry point of `ros2 run perch_sim vio_model`."""
    spin_main(create)


if __name__ == "__main__":
    main()
