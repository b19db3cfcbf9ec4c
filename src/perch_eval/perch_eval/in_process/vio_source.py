"""Where VIO poses come from: the error model (`perch_sim.vio_model`), or the real VIO on rendered images."""

from __future__ import annotations

import numpy as np

from perch_core.camera import CameraMount
from perch_eval.estimation_flight import received
from perch_eval.in_process.wire import received_velocity
from perch_perception.ukf import ImuSample, VioPose
from perch_perception.ukf.odometry import vio_pose
from perch_perception.vio import VioConfig, VisualInertialOdometry
from perch_sim import seeding
from perch_sim.camera_stream import Delivery
from perch_sim.state_history import StateHistory, TrueState
from perch_sim.vio_model import VioModel, VioModelParameters

MEMORY = 200  # true states kept: 0.4 s


class ModelledVio:
    """Mirrors `perch_sim.vio_model_node`."""

    def __init__(self, params: VioModelParameters, mount: CameraMount) -> None:
        self._offset = round(mount.stamp_offset * 1e9)
        self._model = VioModel(params, seeding.stream(params.seed, "vio_model"))
        self._history = StateHistory(MEMORY)
        self._newest = 0

    def see(self, state: TrueState, imu: ImuSample) -> None:
        """Take in what one step shows."""
        self._newest = state.time
        v_WB = received_velocity(state.q_WB, state.v_WB)
        self._history.append(TrueState(state.time, np.concatenate([state.x[:7], v_WB, state.x[10:]])))

    def covers(self, delivery: Delivery) -> bool:
        """Whether a frame's exposure has passed on the board's clock."""
        return delivery.frame.stamp - self._offset <= self._newest

    def answer(self, delivery: Delivery) -> VioPose | None:
        """The pose for one frame of the camera."""
        try:
            state = self._history.at(delivery.frame.stamp - self._offset)
        except LookupError:
            return None
        e = self._model.degrade(state.time * 1e-9, state.p_WB, state.q_WB, state.v_WB)
        v_WB = received_velocity(e.q_WB, e.v_WB)
        return vio_pose(state.time, e.p_WB, e.q_WB, np.diag(e.pose_variance), v_WB, e.velocity_variance * np.eye(3))


class RenderedVio:
    """Mirrors `perch_perception.vio_node` on the images of the downward camera."""

    def __init__(self, params: VioConfig, mount: CameraMount, standing_height: float) -> None:
        standing = np.array(params.start_position) + [0.0, 0.0, standing_height]
        self._vio = VisualInertialOdometry(params, mount, standing, float(np.radians(params.start_yaw_deg)),
                                         float(params.start_position[2]))

    def see(self, state: TrueState, imu: ImuSample) -> None:
        """Take in what one step shows."""
        self._vio.add_imu(imu)

    def covers(self, delivery: Delivery) -> bool:
        """Whether the IMU has passed a frame's exposure."""
        return self._vio.covers(delivery.frame.stamp)

    def answer(self, delivery: Delivery) -> VioPose | None:
        """The pose for one frame of the camera, where VIO has one."""
        result = self._vio.add_image(delivery.frame.stamp, np.array(delivery.image.result()))
        e = result.estimate
        if e is None:
            return None
        return received(e)
