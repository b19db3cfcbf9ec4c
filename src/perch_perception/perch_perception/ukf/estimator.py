"""State estimator: mean at every IMU step, unscented update at the stamp of a VIO pose, replay to the newest sample. [M:IV-B]

Each IMU sample propagates the nominal state by one integration step (a few us). A measurement (a pose and, where given, a
velocity) is applied to the belief at its own stamp; the later IMU steps are replayed through a full unscented transform. Where
VIO provides its full state, this replaces the belief. The equations are in docs/estimation.md.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from perch_core.values import ImuSample, RotorState
from perch_perception.ukf import kernels, start
from perch_perception.ukf import layout as at
from perch_perception.ukf.config import UkfConfig
from perch_perception.ukf.imu_buffer import ImuBuffer, ImuOutcome
from perch_perception.ukf.measurement import Estimate, Health, Status, VioOutcome, VioPose
from perch_perception.ukf.rest import after_rest, after_stop
from perch_perception.ukf.stillness import WINDOW, is_at_rest, rotors_stand, window
from perch_perception.ukf.unscented import GATES, Belief, CovarianceError, Innovation, UnscentedTransform

_HISTORY = 0.5  # IMU kept for replay: VIO is late by 0.04 s, by 0.08 s in the campaign on robustness [s]
_MAX_CONSECUTIVE_REJECTIONS = 15  # rejections in a row after which VIO is taken to have jumped
_UNTRUSTED_VELOCITIES = 30  # after a start or a jump, only the pose of so many measurements is used, which shows whether their velocity fits
_LOST_POSITION = 2.0  # 1 sigma beyond which the state is not to be used [m]
_LOST_ATTITUDE = 0.6  # the same [rad]
COVARIANCE_STRIDE = 5  # IMU steps per update of the published covariance
_MAX_STAMP_LEAD = 50_000_000  # VIO stamps so far ahead wait for the IMU, later ones are refused [ns]
_MAX_WAITING = 20  # poses ahead of the IMU that are kept


class Estimator:
    """Estimator that fuses IMU samples and delayed VIO poses, and owns its state.

    Call `add_imu`, `add_vio` and `add_rotors` in order of arrival, and read `estimate` and `status`. The same inputs give
    bit-identical outputs.
    """

    def __init__(self, config: UkfConfig = UkfConfig()) -> None:
        self.config = config
        self._transform, self._added_noise = UnscentedTransform(config), start.added_noise(config.vio)
        self._imu = ImuBuffer(config.imu, _HISTORY)
        self._base: Belief | None = None  # at the stamp of the last applied pose, or of rest
        self._newest_vio_stamp = self._applied = 0   # newest stamp of any pose, and of an applied one [ns]
        self._resting = False  # the base is one of rest
        self._rotors: RotorState | None = None  # the newest
        self._live: Belief | None = None  # covariance up to a few steps ago
        self._anchors: list[Belief] = []  # where a replay can begin: the base and, without VIO for long, later beliefs
        self._x = np.zeros(at.NOMINAL_SIZE)  # nominal state now
        self._lag = 0
        self._waiting: list[VioPose] = []
        self._refused_in_row = self._untrusted = 0  # untrusted: coming measurements of which only the pose is used
        self._accepted = self._rejected = self._divergences = 0
        self._nis, self._nis_dimension = 0.0, 0
        self._diverged = False
        self._message = "waiting for the IMU"
        self._compile()

    def add_imu(self, sample: ImuSample) -> ImuOutcome:
        """Propagate the estimate to the sample's stamp; bad samples are bridged or refused, see `ImuOutcome`."""
        outcome = self._imu.add(sample)
        if outcome is not ImuOutcome.USED:
            self._message = f"IMU sample at {sample.stamp} ns {outcome.value}"
        if not outcome.used:
            return outcome
        if self._base is not None:
            row = self._imu.latest
            kernels.advance(self._x, row[1], row[2], row[3], row[4], row[5], row[6], row[0])
            self._lag += 1
            if self._lag >= COVARIANCE_STRIDE or outcome is ImuOutcome.GAP:  # after which the covariance is another one
                self._refresh()
                self._rest()
        while self._waiting and self._waiting[0].stamp <= self._imu.newest.stamp:
            self.add_vio(self._waiting.pop(0))
        return outcome

    def add_vio(self, pose: VioPose) -> VioOutcome:
        """Apply a VIO pose at its stamp and replay the IMU; the outcome states why a pose is refused or has to wait."""
        outcome = pose.problem() or self._timing(pose)
        if outcome is None:
            try:
                outcome = self._apply(pose) if self._base is not None else self._begin(pose)
            except CovarianceError as error:
                self._diverge(str(error))
                return VioOutcome.BROKEN
        if outcome is VioOutcome.GATED:
            self._rejected += 1
        elif outcome.used:
            self._accepted += 1
            self._applied, self._resting = pose.stamp, False
        if outcome not in (VioOutcome.APPLIED, VioOutcome.WAITING):
            self._message = f"VIO pose at {pose.stamp} ns {outcome.value}"
        return outcome

    def add_rotors(self, rotors: RotorState) -> None:
        """Store the state of the rotors: a vehicle with a quiet IMU rests where they stand."""
        self._rotors = rotors

    @property
    def estimate(self) -> Estimate | None:
        """State at the newest IMU stamp; None until a first VIO pose, also after a divergence."""
        if self._live is None:
            return None
        last, x = self._imu.newest, self._x.copy()
        return Estimate(
            stamp=last.stamp, p_WB=x[at.POSITION], v_WB=x[at.VELOCITY], q_WB=x[at.QUATERNION],
            w_WB_B=np.array(last.w_B) - x[at.GYRO_BIAS], gyro_bias=x[at.GYRO_BIAS], accel_bias=x[at.ACCEL_BIAS],
            P=self._live.P)

    @property
    def motion(self) -> tuple[float, ...] | None:
        """p_WB, v_WB, q_WB and w_WB_B of `estimate`, 13 floats, in a tenth of its time."""
        if self._live is None:
            return None
        x, (a, b, c) = self._x.tolist(), self._imu.newest.w_B
        return (*x[:10], a - x[10], b - x[11], c - x[12])

    @property
    def gyro_sigma(self) -> float:
        """1 sigma of the newest gyro sample [rad/s]."""
        return self._imu.gyro_sigma

    @property
    def status(self) -> Status:
        """Health and diagnostics of the estimator."""
        age, position, attitude, message = math.inf, math.inf, math.inf, self._message
        health = Health.DIVERGED if self._diverged else Health.INITIALISING
        if self._live is not None:
            age = (self._imu.newest.stamp - self._applied) * 1e-9
            diagonal = np.diag(self._live.P)
            position = float(np.sqrt(diagonal[at.D_POSITION].max()))
            attitude = float(np.sqrt(diagonal[at.D_ATTITUDE].max()))
            lost = position > _LOST_POSITION or attitude > _LOST_ATTITUDE
            health = Health.DIVERGED if lost else Health.COASTING if age > self.config.coasting_after else Health.RUNNING
            message = f"1 sigma of {position:.1f} m and {attitude:.2f} rad is too uncertain; {message}" if lost else message
        return Status(health, age, self._accepted, self._rejected, self._divergences, self._nis, self._nis_dimension, position, attitude, message)

    def _compile(self) -> None:
        """Run the compiled functions once: their first compilation takes seconds, which must not happen in flight."""
        pose = VioPose(0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.eye(6), np.zeros(3), np.eye(3))
        pose.problem()
        row = np.array([[0.002, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 1e-4, 0.1]])
        belief = start.from_pose(self.config, pose, row)
        prior = self._transform.predict(belief, row, 2_000_000)
        self._transform.correct(prior, self._innovate(prior, pose))
        kernels.advance(belief.x.copy(), 0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 0.002)

    def _timing(self, pose: VioPose) -> VioOutcome | None:
        """Return why a pose cannot be applied now, or None; a pose slightly ahead of the IMU is queued."""
        last = self._imu.last
        if last is None:
            return VioOutcome.NO_IMU
        self._newest_vio_stamp = max(self._newest_vio_stamp, min(pose.stamp, last.stamp))
        if self._base is not None and pose.stamp <= self._base.stamp:
            return VioOutcome.DUPLICATE if pose.stamp == self._base.stamp else VioOutcome.OUT_OF_ORDER
        if pose.stamp > last.stamp:
            if pose.stamp > last.stamp + _MAX_STAMP_LEAD:
                return VioOutcome.FUTURE
            if any(w.stamp == pose.stamp for w in self._waiting):
                return VioOutcome.DUPLICATE
            if len(self._waiting) >= _MAX_WAITING:
                return VioOutcome.FUTURE
            self._waiting = sorted([*self._waiting, pose], key=lambda w: w.stamp)
            return VioOutcome.WAITING
        oldest = self._imu.oldest
        if pose.stamp < min((a.stamp for a in self._anchors if a.stamp >= oldest), default=oldest):
            return VioOutcome.TOO_OLD
        return None

    def _begin(self, pose: VioPose) -> VioOutcome:
        steps = window(self._imu, pose.stamp)
        self._set_base(start.from_pose(self.config, pose, steps) if pose.inertial is None else start.from_state(pose, pose.inertial))
        self._diverged, self._untrusted = False, _UNTRUSTED_VELOCITIES
        return VioOutcome.STARTED

    def _apply(self, pose: VioPose) -> VioOutcome:
        anchor = self._anchor(pose.stamp)
        prior = self._transform.predict(anchor, self._imu.run(anchor.stamp, pose.stamp), pose.stamp)
        if self._untrusted > 0 and pose.inertial is None:
            self._untrusted, pose = self._untrusted - 1, dataclasses.replace(pose, velocity_covariance=None)
        innovation, outcome = self._innovate(prior, pose), VioOutcome.APPLIED
        if innovation.nis > GATES[len(innovation.residual)] and pose.inertial is None:
            alone = self._innovate(prior, dataclasses.replace(pose, velocity_covariance=None))
            if alone.nis <= GATES[len(alone.residual)]:
                innovation, outcome = alone, VioOutcome.POSE_ONLY
        self._nis, self._nis_dimension = innovation.nis, len(innovation.residual)
        if innovation.nis > GATES[self._nis_dimension]:
            self._refused_in_row += 1
            if self._refused_in_row < _MAX_CONSECUTIVE_REJECTIONS:
                return VioOutcome.GATED
            prior, outcome = self._inflated(prior, innovation), VioOutcome.JUMPED
            innovation, self._untrusted = self._innovate(prior, pose), _UNTRUSTED_VELOCITIES
        self._set_base(self._transform.correct(prior, innovation) if pose.inertial is None else start.from_state(pose, pose.inertial))
        return outcome

    def _anchor(self, stamp: int) -> Belief:
        """Return the newest anchor that is not after a stamp [ns]: the history of the IMU reaches back to anchors only, not to the base."""
        return next(a for a in reversed(self._anchors) if a.stamp <= stamp)

    def _innovate(self, prior: Belief, pose: VioPose) -> Innovation:
        m = 6 if pose.velocity_covariance is None else 9
        R = np.zeros((m, m))
        R[:6, :6] = pose.covariance + self._added_noise
        if pose.velocity_covariance is not None:
            R[6:, 6:] = pose.velocity_covariance
        return self._transform.innovate(prior, pose, R)

    def _inflated(self, prior: Belief, innovation: Innovation) -> Belief:
        """Return the prior with a covariance enlarged by the residual: position, attitude, and the velocity that explains it."""
        assert self._base is not None
        elapsed = max((prior.stamp - self._base.stamp) * 1e-9, 0.1)
        p, theta = (innovation.residual[:3] ** 2).sum(), (innovation.residual[3:6] ** 2).sum()
        extra = np.repeat([p, p / elapsed**2, theta, 0.0, 0.0], 3)
        return dataclasses.replace(prior, P=prior.P + np.diag(extra))

    def _set_base(self, belief: Belief) -> None:
        """Make a belief the new base, and predict the live state from there to the newest IMU stamp."""
        self._base, self._refused_in_row, self._anchors = belief, 0, [belief]
        now = self._imu.newest.stamp
        self._live = self._transform.predict(belief, self._imu.run(belief.stamp, now), now)
        self._x, self._lag = self._live.x.copy(), 0

    def _rest(self) -> None:
        """Without VIO poses, apply rest up to the middle of the window where the vehicle rests; a departure may just have begun.

        Skipped while VIO poses arrive: VIO applies rest itself, or measures the pose at rest. A vehicle may hover as quietly
        as it would rest: a rest begins only where the rotors stand.
        """
        now, config = self._imu.newest.stamp, self.config
        if self._base is None or self._live is None:
            return
        belief, middle = self._base, now - round(0.5e9 * WINDOW)
        if belief.stamp >= middle or now - max(self._newest_vio_stamp, belief.stamp) < round(1e9 * config.coasting_after):
            return
        steps = window(self._imu, now)
        may_rest = self._resting or rotors_stand(self._rotors, now)
        if not may_rest or not is_at_rest(steps, belief.x[10:16], np.diag(self._live.P)[9:15]):
            self._resting = False
            return
        try:
            if not self._resting:
                begin = max(belief.stamp, 2 * middle - now)
                if self._anchors[0].stamp > begin:  # the IMU has just come back after a gap longer than its history
                    return
                anchor = self._anchor(begin)
                stopped = after_stop(self._transform.predict(anchor, self._imu.run(anchor.stamp, begin), begin))
                if stopped is None:
                    return
                belief = stopped
            self._resting = True
            self._set_base(after_rest(belief, self._imu.run(belief.stamp, middle), middle, config))
        except CovarianceError as error:
            self._diverge(str(error))

    def _refresh(self) -> None:
        """Propagate the published covariance to the newest IMU stamp, and keep anchors for a replay of the IMU history."""
        live, now = self._live, self._imu.newest.stamp
        assert live is not None  # there is a base
        try:
            self._live = live = self._transform.predict(live, self._imu.run(live.stamp, now), now)
        except CovarianceError as error:
            self._diverge(str(error))
            return
        self._lag = 0
        if not np.isfinite(self._x).all():
            self._diverge("state is not finite")
            return
        half = round(0.5e9 * _HISTORY)
        if now - self._anchors[-1].stamp >= half:
            self._anchors = [a for a in self._anchors if a.stamp >= now - 2 * half] + [live]

    def _diverge(self, why: str) -> None:
        """Discard the state after a divergence; the next VIO pose restarts the filter."""
        self._base = self._live = None
        self._anchors, self._divergences = [], self._divergences + 1
        self._diverged, self._message = True, f"diverged: {why}; waiting for VIO to start again"
