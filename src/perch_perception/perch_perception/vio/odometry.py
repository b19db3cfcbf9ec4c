"""Visual-inertial odometry: IMU samples and images in, poses with covariance out. [M:IV-B]

Ties tracker and filter together and decides what a frame is for: waiting for a start, standing still, tracking, blind, or
lost. Free of ROS; the same inputs give the same outputs.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from perch_core.camera import Camera, CameraMount
from perch_core.values import ImuSample
from perch_perception.ukf.imu_buffer import ImuBuffer, ImuOutcome
from perch_perception.ukf.stillness import still, window
from perch_perception.vio import ekf, ground, motion_start, rest, start
from perch_perception.vio import state as at
from perch_perception.vio.bearing import POINT, observe, residuals
from perch_perception.vio.config import VioConfig
from perch_perception.vio.msckf import FrameReport, Msckf
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.result import FrameOutcome, VioPoseEstimate, VioResult
from perch_perception.vio.start import KnownPose
from perch_perception.vio.tracker import Features, Tracker
from perch_perception.vio.triangulation import triangulate

_FUTURE = 500_000_000  # an image this far ahead of the IMU cannot be right [ns]
_INERTIAL = np.r_[at.POSITION, at.VELOCITY, at.THETA, at.GYRO_BIAS, at.ACCEL_BIAS]  # the order of an estimate's covariance


class VisualInertialOdometry:
    """Owns tracker, filter and IMU history.

    Call `add_imu` with every sample; call `add_image` once `covers(stamp)` says that the IMU has passed the exposure.
    """

    def __init__(self, config: VioConfig, mount: CameraMount, p_WB: np.ndarray = np.zeros(3), yaw: float = 0.0,
                 floor: float | None = None) -> None:
        """
        Args:
            config: all settings.
            mount: the camera as calibrated.
            p_WB: position of the body in W at the start [m], shape (3,).
            yaw: of the body in W at the start [rad].
            floor: height in W of the level ground that it stands on [m]; None: unknown.
        """
        self.config = config
        self.filter: Msckf | None = None
        self.restarts = 0
        self._imu = ImuBuffer(config.imu, config.faults, 2.0 + config.start.motion_time)
        self._known = start.told(config, p_WB, yaw)
        self._floor = floor
        self._views: deque[tuple[int, Features]] = deque()  # (exposed, features) of frames at rest that the filter has not passed
        self._gyro_bias = np.zeros(3)
        self._resting = False
        self._told = True     # it stands where it was told to start
        self._sight: int | None = None  # when vision last changed the state; None: not since the last rest
        self._frame = 0
        self._last_image = -1           # stamp of the last frame used, on the board's clock
        self._last_exposed: int | None = None
        self._informed = 0              # when vision or rest last updated the filter
        self._bad_frames = 0
        self._look_through(mount)

    def _look_through(self, mount: CameraMount) -> None:
        self.mount = mount
        self.tracker = Tracker(self.config.tracker, mount.camera)
        self._moving = motion_start.MotionStart(self.config, mount)
        _compile(mount.camera)

    def use_camera(self, mount: CameraMount) -> None:
        """Go on with another camera, or another calibration of it: a filter that flies starts again in motion."""
        if self._resting:
            self._know()
            self.filter, self._resting = None, False  # nothing is lost: it still stands there
        elif self.filter is not None:
            self._forget_state()
        self._views.clear()
        self._look_through(mount)

    @property
    def time_offset(self) -> float:
        """Middle of the exposure on the IMU's clock minus the image's stamp, as estimated [s]."""
        return self.filter.state.time_offset if self.filter else -self.mount.stamp_offset

    def covers(self, stamp: int) -> bool:
        """Whether the IMU has passed the exposure of an image with this stamp [ns], or the stamp cannot be waited for."""
        newest = self._imu.last.stamp if self._imu.last else None
        exposed = stamp + round(self.time_offset * 1e9)
        return newest is not None and (exposed <= newest or exposed > newest + _FUTURE)

    def add_imu(self, sample: ImuSample) -> ImuOutcome:
        """Keep a sample; bad ones are bridged or refused, see `ImuOutcome`."""
        return self._imu.add(sample)

    def add_image(self, stamp: int, image: np.ndarray) -> VioResult:
        """Use a frame.

        Args:
            stamp: of the board [ns].
            image: grey, uint8 (height, width).
        """
        exposed = stamp + round(self.time_offset * 1e9)
        problem = self._problem(stamp, exposed, image)
        if problem is not None:
            return VioResult(problem, restarts=self.restarts, message=f"frame {stamp} ns {problem.value}")
        self._last_image = stamp
        features = self._track(image, exposed)
        self._frame += 1
        if self.filter is None:
            result = self._try_start(exposed, features)
        else:
            result = self._step(exposed, features)
        self._last_exposed = exposed
        return result

    def _problem(self, stamp: int, exposed: int, image: np.ndarray) -> FrameOutcome | None:
        camera = self.mount.camera
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width):
            return FrameOutcome.BAD_IMAGE
        if self._imu.last is None:
            return FrameOutcome.NO_IMU
        if stamp <= self._last_image or (self.filter and exposed <= self.filter.state.stamp):
            return FrameOutcome.NOT_NEWER
        if exposed > self._imu.last.stamp:
            return FrameOutcome.FUTURE
        if exposed < self._imu.oldest or (self.filter and self.filter.state.stamp < self._imu.oldest):
            return FrameOutcome.TOO_OLD
        return None

    def _track(self, image: np.ndarray, exposed: int) -> Features:
        state = self.filter.state if self.filter else None
        R_BC = state.R_BC if state else self.mount.R_BC
        turn = np.eye(3)
        if self._last_exposed is not None:
            steps = self._imu.run(self._last_exposed, exposed)
            turn = preintegrate(steps, state.gyro_bias if state else self._gyro_bias, np.zeros(3)).dR
            if state is None:
                self._known = replace(self._known, R_WB=self._known.R_WB @ turn)
        return self.tracker.track(image, R_BC.T @ turn.T @ R_BC)

    # -- before the start --------------------------------------------------------------------------------------------

    def _try_start(self, exposed: int, features: Features) -> VioResult:
        """Start at rest or, when the vehicle moves, from the frames of the last half second."""
        steps = window(self.config.rest, self._imu, exposed)
        if self._quiet(features) and still(self.config.rest, self.config.imu, steps):
            self._begin(start.at_rest(self.config, self.mount, exposed, steps, self._known))
            return self._hold(exposed, features)
        self._moving.add(self._frame, exposed, features.ids, observe(self.mount.camera, features.pixels))
        state = self._moving.solve(self._imu, self._known, self._gyro_bias)
        if state is not None:
            self._begin(state)
            self._told, self._sight = False, exposed
            return self._result(FrameOutcome.TRACKING, features, FrameReport())
        outcome = FrameOutcome.LOST if self.restarts else FrameOutcome.INITIALISING
        return VioResult(outcome, None, len(features.ids), restarts=self.restarts, message=outcome.value)

    def _begin(self, state: at.State) -> None:
        self.filter = Msckf(self.config, state, self.mount.camera.fx)
        self._informed, self._bad_frames = state.stamp, 0

    # -- afterwards --------------------------------------------------------------------------------------------------

    def _step(self, exposed: int, features: Features) -> VioResult:
        if self._is_still(exposed, features):
            return self._hold(exposed, features)
        if self._resting and self._told and self._floor is not None and not self.filter.state.landmarks:
            self._stand_on(features)
        self._resting = False
        self.filter.propagate(self._imu.run(self.filter.state.stamp, exposed), exposed)
        report = self.filter.add_frame(self._frame, features.ids, observe(self.mount.camera, features.pixels))
        if report.used:
            self._sight, self._told = exposed, False
        return self._judge(exposed, features, report)

    def _is_still(self, exposed: int, features: Features) -> bool:
        """Whether the vehicle rests: the IMU says so, nothing moves in the image, and it is not known to move steadily.

        While vision says where the vehicle is, nobody asks: a very quiet hover looks like rest.
        """
        state = self.filter.state
        if self._sight is not None and exposed - self._sight < round(1e9 * self.config.loss.degraded_after):
            return False
        return (self._quiet(features) and still(self.config.rest, self.config.imu, window(self.config.rest, self._imu, exposed), state.gyro_bias)
                and (self._resting or rest.can_stand(state)))

    def _quiet(self, features: Features) -> bool:
        """Nothing moves in the image, or there is nothing in it."""
        return (features.disparity < self.config.start.rest_disparity or not np.isfinite(features.disparity)
                or len(features.ids) < self.config.loss.least_tracks)

    def _hold(self, exposed: int, features: Features) -> VioResult:
        """Tell the filter that the vehicle stood still, up to a little before now.

        A take-off is noticed some time after it began. The filter stays behind by `rest_lag`, so that what it was told
        remains true, and catches up with the IMU when the vehicle leaves.
        """
        state = self.filter.state
        until = max(state.stamp, exposed - round(self.config.start.rest_lag * 1e9))
        if not self._resting:
            self.filter.propagate(self._imu.run(state.stamp, until), until)
            rest.stop(self.filter)
            self._resting, self._sight = True, None
            self._views.clear()
        steps = self._imu.run(state.stamp, until)
        if len(steps):
            rest.hold(self.filter, steps, until)
        self._informed = exposed
        self._views.append((exposed, features))
        while len(self._views) > 1 and self._views[1][0] <= state.stamp:
            self._views.popleft()
        result = self._result(FrameOutcome.RESTING, features, FrameReport())
        # what is said of now, not of `until`: a take-off may just have begun
        P = result.estimate.P.copy()
        P[3:6, 3:6] += self.config.start.unnoticed_velocity**2 * np.eye(3)
        return replace(result, blind_for=0.0, estimate=replace(result.estimate, stamp=exposed, w_WB_B=np.zeros(3), P=P))

    def _stand_on(self, features: Features) -> None:
        """What was seen of the ground while the vehicle stood, and still is, becomes its first landmarks."""
        exposed, view = self._views[0]
        if exposed > self.filter.state.stamp:
            return
        known = np.isin(view.ids, features.ids)
        known[len(view.ids) - view.new:] = False
        s = self.config.start
        ground.take_in(self.filter, view.ids[known], observe(self.mount.camera, view.pixels[known]), self._floor,
                       s.ground_sigma, s.ground_least_height)

    def _judge(self, exposed: int, features: Features, report: FrameReport) -> VioResult:
        """Whether the filter still sees, or has to start again."""
        loss, s = self.config.loss, self.filter.state
        if report.used or len(features.ids) - features.new >= loss.least_tracks:
            self._informed = exposed  # tracks that go on carry information that is used when they end
        self._bad_frames = self._bad_frames + 1 if report.refused > 2 * report.used + 2 else 0
        sigma = np.sqrt(np.diag(s.P))
        why = ""
        if not np.isfinite(s.P).all() or not np.isfinite(s.p_WB).all():
            why = "state is not finite"
        elif self._bad_frames >= loss.rejected_frames:
            why = f"most observations refused in {self._bad_frames} frames in a row"
        elif sigma[at.VELOCITY].max() > loss.restart_velocity:
            why = f"velocity known only to {sigma[at.VELOCITY].max():.1f} m/s"
        if why:
            return self._lose(features, why)
        blind = (exposed - self._informed) * 1e-9
        outcome = FrameOutcome.TRACKING
        if blind > loss.degraded_after:
            # in the first decimetres the floor is a blur; the standstill's knowledge carries the vehicle over them
            leaving = self._sight is None and sigma[at.VELOCITY].max() < loss.leaving_velocity
            outcome = FrameOutcome.LEAVING if leaving else FrameOutcome.BLIND
        return self._result(outcome, features, report)

    def _lose(self, features: Features, why: str) -> VioResult:
        """Keep what is known of position and heading, and start again in motion."""
        self._forget_state()
        return VioResult(FrameOutcome.LOST, None, len(features.ids), restarts=self.restarts, message=f"lost: {why}")

    def _forget_state(self) -> None:
        self._know()
        self._moving = motion_start.MotionStart(self.config, self.mount)
        self.filter, self._resting, self._told, self.restarts = None, False, False, self.restarts + 1

    def _know(self) -> None:
        """Keep what a new start needs."""
        s = self.filter.state
        if np.isfinite(s.P).all() and np.isfinite(s.p_WB).all():
            rows = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])
            self._known = KnownPose(s.p_WB.copy(), s.R_WB.copy(), self._estimate().pose_covariance[rows])
            self._gyro_bias = s.gyro_bias.copy()

    def _result(self, outcome: FrameOutcome, features: Features, report: FrameReport) -> VioResult:
        s = self.filter.state
        return VioResult(outcome, self._estimate() if outcome.has_pose else None, len(features.ids), report.used, report.refused,
                         report.nis, report.nis_dimension, (s.stamp - self._informed) * 1e-9, self.restarts, outcome.value)

    def _estimate(self) -> VioPoseEstimate:
        s = self.filter.state
        return VioPoseEstimate(s.stamp, s.p_WB.copy(), s.R_WB.copy(), s.v_WB.copy(), self.filter.w_WB_B.copy(), s.gyro_bias.copy(),
                               s.accel_bias.copy(), s.P[np.ix_(_INERTIAL, _INERTIAL)])


def _compile(camera: Camera) -> None:
    """Run the compiled parts once: on a new machine that takes seconds, which no flight should wait for."""
    row = np.array([[0.002, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 1e-4, 0.1]])
    preintegrate(row, np.zeros(3), np.zeros(3))
    rays = np.array([[0.0, 0.0, -1.0], [-0.6, 0.0, -0.8]])
    centres = np.array([[0.0, 0.0, 1.0], [0.75, 0.0, 1.0]])
    X = triangulate(centres, rays, 0.1, 0.01)
    seen = observe(camera, camera.project(np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]))[0])
    linear = residuals(np.broadcast_to(np.eye(3), (2, 3, 3)), centres, np.array([X, X]), np.eye(3), np.zeros(3), seen)
    ekf.eliminate(linear.J[:, :, :POINT.start].reshape(4, -1), linear.J[:, :, POINT].reshape(4, 3), linear.r.ravel())
