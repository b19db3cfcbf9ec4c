"""Mirrors `perch_perception.estimator_node`: IMU and VIO poses in, one state per step out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_eval.in_process.wire import received_velocity
from perch_perception.pose_buffer import BodyState
from perch_perception.ukf import Estimate, Estimator, ImuSample, Status, UkfConfig, VioPose
from perch_perception.ukf.odometry import covariances

STATUS_STEPS = 50


@dataclass(frozen=True, slots=True)
class Odometry:
    """What `odometry` carries at a step.

    Attributes:
        estimate: the state.
        covariance: of the pose in W, as computed last, shape (6, 6).
        v_WB: the velocity as receivers read it [m/s], shape (3,).
    """

    estimate: Estimate
    covariance: np.ndarray
    v_WB: np.ndarray

    def body(self, time: float) -> BodyState:
        """As those who look back in time keep it."""
        e = self.estimate
        return BodyState(time, e.p_WB, e.q_WB, self.v_WB, e.w_WB_B, self.covariance)

    @property
    def sample(self) -> tuple[float, ...]:
        """As the controller takes it: p_WB, v_WB, q_WB, w_WB_B, 13 floats."""
        e = self.estimate
        return (*e.p_WB.tolist(), *self.v_WB.tolist(), *e.q_WB.tolist(), *e.w_WB_B.tolist())


class Estimation:
    """Owns the estimator."""

    def __init__(self, config: UkfConfig) -> None:
        self._config, self._estimator = config, Estimator(config)
        self._steps, self._covariance_step = 0, -config.covariance_stride
        self._covariance = np.zeros((6, 6))

    def add_vio(self, pose: VioPose) -> None:
        """A VIO pose that counts from this step on."""
        self._estimator.add_vio(pose)
        self._covariance_step = self._steps - self._config.covariance_stride

    def step(self, imu: ImuSample) -> Odometry:
        """The odometry of the step with this IMU sample."""
        self._estimator.add_imu(imu)
        estimate = self._estimator.estimate
        if self._steps - self._covariance_step >= self._config.covariance_stride:
            self._covariance, _ = covariances(so3.quat_to_matrix(estimate.q_WB), estimate.v_WB, estimate.P)
            self._covariance_step = self._steps
        self._steps += 1
        return Odometry(estimate, self._covariance, received_velocity(estimate.q_WB, estimate.v_WB))

    @property
    def status(self) -> Status:
        """Health, as published at every 50th step."""
        return self._estimator.status
