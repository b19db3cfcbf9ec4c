"""The state estimator: IMU and VIO in, odometry at every IMU sample out. [M:IV-B]"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perch_core import so3
from perch_core.component import Component, Diagnostics, Input, Output
from perch_core.errors import PerchError
from perch_core.values import EstimatorHealth, ImuSample, InertialState, OdometryState, RotorState, Transform, rotated
from perch_perception.estimators import EstimatorConfig
from perch_perception.imu_intake import ImuIntake
from perch_perception.sensor_file import imu_noise
from perch_perception.ukf import Estimator, VioOutcome
from perch_perception.ukf.estimator import COVARIANCE_STRIDE
from perch_perception.ukf.imu_buffer import ImuOutcome
from perch_perception.ukf.odometry import covariances, pose_of, state_of
from perch_perception.world_frames import MAP, is_world

STATUS_PERIOD = 100_000_000        # [ns]
DIAGNOSTICS_PERIOD = 1_000_000_000
DIAGNOSTICS_PHASE = 334_000_000    # not with the status
STATE_VALIDITY = 1_000_000_000     # time after VIO's last whole state in which its odometry is ignored [ns]
MAX_PENDING = 20                   # measurements that wait for the next IMU sample
_NEVER = -(1 << 62)


class StateEstimator(Component[EstimatorConfig]):
    """Publishes `odometry` at the stamp of each IMU sample, from the VIO measurements so far; none before VIO's first pose.

    VIO's odometry is ignored while VIO's full state is available: it would add nothing.

    Attributes:
        filter: estimator behind the ports.
    """

    config_type = EstimatorConfig

    imu = Input(ImuSample, "imu/data_raw")
    vio_state = Input(InertialState, "vio/state")
    vio_odometry = Input(OdometryState, "vio/odometry")
    transform = Input(Transform, "/tf_static")
    rotors = Input(RotorState, "rotor_state", lazy=True)
    odometry = Output(OdometryState, "odometry")
    status = Output(EstimatorHealth, "estimator/status")

    def __init__(self, config: EstimatorConfig) -> None:
        super().__init__(replace(config, imu=imu_noise(config.sensors, config.imu)))
        self._intake = ImuIntake(self.warn, config.sensors)
        self._begin()

    def _begin(self) -> None:
        """Reset to the state before the first sample."""
        self.filter = Estimator(self.config)
        self._pending: list[InertialState | OdometryState] = []
        self._newest_state = _NEVER
        self._covariances = (np.zeros((6, 6)), np.zeros((6, 6)))
        self._covariance_age = COVARIANCE_STRIDE  # IMU samples since they were computed
        self._first: int | None = None  # stamp of the first IMU sample
        self._statuses = self._diagnoses = 0

    def on_transform(self, transform: Transform) -> None:
        """Take a static transform, which may be that of the IMU's frame."""
        self._intake.axes.add_transform(transform)

    def on_vio_state(self, state: InertialState) -> None:
        """Keep VIO's state for the next IMU sample."""
        self._queue_measurement("vio/state", state)

    def on_vio_odometry(self, odometry: OdometryState) -> None:
        """Keep VIO's odometry for the next IMU sample."""
        self._queue_measurement("vio/odometry", odometry)

    def on_rotors(self, rotors: RotorState) -> None:
        """Take the state of the rotors: where they stand, a vehicle with a quiet IMU rests."""
        self.filter.add_rotors(rotors)

    def on_imu(self, sample: ImuSample) -> None:
        """Apply the pending VIO measurements, propagate the state to the sample's stamp, and publish it."""
        taken = self._intake.take(sample)
        if taken is None:
            return
        if self._intake.restarted:
            self._begin()
        if self._pending:
            self._use_vio()
        outcome = self.filter.add_imu(taken)
        if outcome is not ImuOutcome.USED:
            self.warn(f"imu/data_raw: sample at {sample.stamp} ns {outcome.value}", 1.0)
        if outcome is ImuOutcome.GAP:
            self._covariance_age = COVARIANCE_STRIDE
        motion = self.filter.motion
        if motion is not None:
            self._emit(sample.stamp, motion)
        if self._first is None:
            if not outcome.used:
                return
            self._first = sample.stamp
        since = sample.stamp - self._first
        if since >= self._statuses * STATUS_PERIOD:
            self._statuses = since // STATUS_PERIOD + 1
            self._emit_status(sample.stamp)
        if since >= self._diagnoses * DIAGNOSTICS_PERIOD + DIAGNOSTICS_PHASE:
            self._diagnoses = (since - DIAGNOSTICS_PHASE) // DIAGNOSTICS_PERIOD + 1
            self._diagnose(sample.stamp)

    def _queue_measurement(self, channel: str, value: InertialState | OdometryState) -> None:
        """Check the frame of a measurement, and store it for the next IMU sample."""
        if not is_world(value.frame):
            self.warn(f"{channel}: frame {value.frame!r} is not a known fixed frame: ignored", 1.0)
            return
        if len(self._pending) >= MAX_PENDING:
            self.warn(f"{channel}: more than {MAX_PENDING} values without an IMU sample: the oldest are dropped", 1.0)
            self._pending.pop(0)
        self._pending.append(value)

    def _use_vio(self) -> None:
        """Apply the stored measurements in the order of their stamps; at the same stamp, the state precedes the odometry."""
        pending, self._pending = sorted(self._pending, key=lambda value: (value.stamp, isinstance(value, OdometryState))), []
        for value in pending:
            stamp, is_odometry = value.stamp, isinstance(value, OdometryState)
            if is_odometry and stamp <= self._newest_state + STATE_VALIDITY:
                continue
            channel = "vio/odometry" if is_odometry else "vio/state"
            try:
                pose = pose_of(value) if isinstance(value, OdometryState) else state_of(value)
            except (PerchError, TypeError, ValueError) as error:
                self.warn(f"{channel}: {error}: not used", 1.0)
                continue
            outcome = self.filter.add_vio(pose)
            if not is_odometry and (outcome.used or outcome in (VioOutcome.DUPLICATE, VioOutcome.WAITING)):
                self._newest_state = stamp
            self._covariance_age = COVARIANCE_STRIDE
            if outcome not in (VioOutcome.STARTED, VioOutcome.APPLIED, VioOutcome.WAITING, VioOutcome.NO_IMU):
                self.warn(f"{channel}: at {stamp} ns {outcome.value}", 1.0)

    def _emit(self, stamp: int, motion: tuple[float, ...]) -> None:
        if self._covariance_age >= COVARIANCE_STRIDE and (e := self.filter.estimate) is not None:
            self._covariances = covariances(so3.quat_to_matrix(e.q_WB), e.v_WB, e.P, self.filter.gyro_sigma)
            self._covariance_age = 0
        self._covariance_age += 1
        p_WB, v_WB, q_WB, w_B = motion[0:3], motion[3:6], motion[6:10], motion[10:13]
        self.odometry(OdometryState(stamp, p_WB, q_WB, rotated(q_WB, v_WB, -1.0), w_B, *self._covariances, MAP))

    def _emit_status(self, stamp: int) -> None:
        s, e = self.filter.status, self.filter.estimate
        biases = ((0.0, 0.0, 0.0),) * 2 if e is None else (tuple(e.gyro_bias.tolist()), tuple(e.accel_bias.tolist()))
        self.status(EstimatorHealth(stamp, s.health.value, s.vio_age, s.accepted, s.rejected, s.nis, *biases,
                                    s.position_sigma, s.attitude_sigma, s.message))

    def _diagnose(self, stamp: int) -> None:
        s = self.filter.status
        level = 0 if s.health.name == "RUNNING" else 2 if s.health.name == "DIVERGED" else 1
        self.diagnostics(Diagnostics(stamp, {"state": s.health.name, "vio_age_s": s.vio_age, "updates_accepted": s.accepted,
                                             "updates_rejected": s.rejected, "covariance_failures": s.broken}, level, s.message))
