"""A STAND-IN for VIO that degrades the truth with drift, noise and latency. Not an estimator: see `perch_sim.vio_model`."""

from __future__ import annotations

from collections import deque

import numpy as np

from perch_core.component import Component, Input, Output
from perch_core.errors import ConfigError
from perch_core.values import NANOSECONDS, CameraModel, InertialState, OdometryState, nanoseconds, rotated
from perch_core.vehicle import load_vehicle
from perch_sim import seeding
from perch_sim.calibration import true_imu
from perch_sim.imu import Imu
from perch_sim.lockstep import START
from perch_sim.state_history import StateHistory, TrueState
from perch_sim.vio_model import CAMERA, BiasModel, VioModel, VioModelParameters

HISTORY_LENGTH = 200      # true states kept: 0.4 s
MAX_PENDING_FRAMES = 20   # that wait for the truth to cover their exposure, or for their estimate to be due
MAX_LEAD = NANOSECONDS    # of a frame over the truth [ns]
RATE_VARIANCE = 1e-4      # of each axis of the angular velocity [rad^2/s^2]


class ModelledVio(Component[VioModelParameters]):
    """Emits one `vio/state` and one `vio/odometry` per camera frame, stamped with the middle of its exposure on the IMU's clock.

    Its input is `camera_info` instead of images, so that it works with the cameras off.
    """

    config_type = VioModelParameters

    truth = Input(OdometryState, "ground_truth/odometry")
    camera_info = Input(CameraModel, f"camera_{CAMERA}/camera_info")
    state = Output(InertialState, "vio/state")
    odometry = Output(OdometryState, "vio/odometry")

    def __init__(self, config: VioModelParameters) -> None:
        """
        Raises:
            ConfigError: the vehicle does not exist or has no such camera.
        """
        super().__init__(config)
        vehicle = load_vehicle(config.vehicle)
        if CAMERA not in vehicle.mounts:
            raise ConfigError("vio_model", "vehicle", f"{vehicle.name} has no camera {CAMERA!r}")
        self._offset = nanoseconds(vehicle.mounts[CAMERA].stamp_offset)
        imu = true_imu(vehicle.imu, config.seed)
        turn_on = Imu(imu, seeding.stream(config.seed, "imu")).bias
        self._biases = BiasModel(imu, np.concatenate([turn_on[3:], turn_on[:3]]),
                                 seeding.stream(config.seed, "vio_model_biases"))
        self._latency = nanoseconds(config.latency)
        self._warned = False
        self._reset()

    def _reset(self) -> None:
        self._model = VioModel(self.config, seeding.stream(self.config.seed, "vio_model"))
        self._history, self._newest = StateHistory(HISTORY_LENGTH), 0
        self._frames: deque[int] = deque(maxlen=MAX_PENDING_FRAMES)  # stamps of frames without an estimate
        self._last_frame = 0
        self._pending_outputs: deque[tuple[int, InertialState, OdometryState]] = deque(maxlen=MAX_PENDING_FRAMES)  # (when it is due, ...)

    def on_truth(self, state: OdometryState) -> None:
        """Store a true state, and answer the frames that it covers."""
        if not self._warned:
            self._warned = True
            self.warn("vio_model is a stand-in: vio/odometry is the truth with drift and noise")
        if state.stamp <= self._newest:
            self.warn("ground_truth/odometry: stamps went back: estimator reset", min_interval=1.0)
            self._reset()
        self._newest = state.stamp
        self._history.append(TrueState(state.stamp, np.array((*state.p_WB, *state.q_WB, *state.v_WB, *state.w_B))))
        if self._frames:
            self._estimate_frames()
        self._emit()

    def on_camera_info(self, model: CameraModel) -> None:
        """Record a frame, which is answered when the truth covers its exposure."""
        if not self._last_frame < model.stamp <= self._newest + MAX_LEAD:
            self.warn(f"camera_{CAMERA}/camera_info: a stamp went back or is ahead of the truth: ignored", min_interval=1.0)
            return
        self._last_frame = model.stamp
        self._frames.append(model.stamp)
        self._estimate_frames()
        self._emit()

    def _estimate_frames(self) -> None:
        """Compute the estimates of all frames whose exposure the truth covers."""
        while self._frames and self._frames[0] - self._offset <= self._newest:
            exposed = self._frames.popleft() - self._offset
            try:
                state = self._history.at(exposed)
            except LookupError as error:
                self.warn(f"frame without truth: {error}", min_interval=1.0)
            else:
                self._pending_outputs.append((exposed + self._latency, *self._estimate(state)))

    def _estimate(self, state: TrueState) -> tuple[InertialState, OdometryState]:
        e = self._model.degrade(state.time * 1e-9, state.p_WB, state.q_WB, state.v_WB)
        biases, variances = self._biases.at(max(0, state.time - START) * 1e-9)
        P = np.zeros((15, 15))
        P[:9, :9] = e.covariance
        P[9:, 9:] = np.diag(variances)
        inertial = InertialState(state.time, e.p_WB, e.q_WB, e.v_WB, biases[:3], biases[3:], P)
        q_WB = tuple(e.q_WB.tolist())
        odometry = OdometryState(
            state.time, tuple(e.p_WB.tolist()), q_WB, rotated(q_WB, e.v_WB.tolist(), -1.0), tuple(state.w_WB_B.tolist()),
            e.pose_covariance, np.diag([e.velocity_variance] * 3 + [RATE_VARIANCE] * 3), "odom")
        return inertial, odometry

    def _emit(self) -> None:
        while self._pending_outputs and self._pending_outputs[0][0] <= self._newest:
            _, inertial, odometry = self._pending_outputs.popleft()
            self.state(inertial)
            self.odometry(odometry)
