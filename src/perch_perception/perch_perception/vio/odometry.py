"""Visual-inertial odometry: IMU samples and images in, poses with covariance out. [M:IV-B]

Connects tracker and filter and decides the outcome of each frame: waiting for a start, standing still, tracking, blind, or
lost. Independent of ROS; the same inputs give the same outputs.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from perch_core.camera import Camera
from perch_core.camera_mount import CameraMount
from perch_core.values import ImuSample, OdometryState, RotorState
from perch_perception.ukf.imu_buffer import ImuBuffer, ImuOutcome, without_gaps
from perch_perception.ukf.odometry import pose_of
from perch_perception.ukf.stillness import MAX_ACCEL_BIAS, MAX_GYRO_BIAS, energy, is_at_rest, rotors_stand, window
from perch_perception.ukf.unscented import GYRO
from perch_perception.vio import ekf, ground, motion_start, rest, start
from perch_perception.vio import state as at
from perch_perception.vio.bearing import POINT, Bearings, observe, residuals
from perch_perception.vio.config import VioConfig
from perch_perception.vio.divergence import SPEED_MAX, divergence, velocity_sigma
from perch_perception.vio.last_pose import LastPose
from perch_perception.vio.msckf import FrameReport, Msckf
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.recent_views import MIN_TRACKS, STATIC_DURATION, RecentViews
from perch_perception.vio.result import FrameOutcome, VioPoseEstimate, VioResult
from perch_perception.vio.start import KnownPose
from perch_perception.vio.tracker import Features, Tracker
from perch_perception.vio.triangulation import triangulate

_REST_DELAY = 0.25  # the filter stays this far behind while it stands still [s]
_MAX_BLIND_NO_TRACKS = 0.15  # longest time without a visual update where nothing is tracked [s]
_MAX_BLIND = 0.5  # the same while features are tracked [s]
_MAX_BLIND_TAKE_OFF = 1.0  # the same at a take-off, from rest on [s]
_MAX_TAKE_OFF_SIGMA = 0.05  # largest 1 sigma of the velocity in a blind take-off [m/s]
_UNSEEN_SPEED = 1.0  # of a vehicle that left its place while there were no images [m/s]
_DIVERGENCE_FRAMES = 15  # frames over which observations that are refused and used are counted
_MAX_STAMP_LEAD = 500_000_000  # an image this far ahead of the IMU cannot be right [ns]
_KEPT_ODOMETRY = 200  # values: 0.4 s at 500 Hz, longer than an image takes
_INERTIAL = np.r_[at.POSITION, at.VELOCITY, at.THETA, at.GYRO_BIAS, at.ACCEL_BIAS]  # the order of an estimate's covariance


class VisualInertialOdometry:
    """Visual-inertial odometry: owns tracker, filter and IMU history.

    Call `add_imu` with every sample, and `add_image` once `covers(stamp)` is true: the IMU has then passed the exposure.
    """

    def __init__(self, config: VioConfig, mount: CameraMount, p_WB: np.ndarray = np.zeros(3), yaw: float = 0.0,
                 floor: float | None = None) -> None:
        """
        Args:
            config: all settings.
            mount: the camera as calibrated.
            p_WB: position of the body in W at the start [m], shape (3,).
            yaw: of the body in W at the start [rad].
            floor: height in W of the level ground under the vehicle [m]; None: unknown.
        """
        self.config = config
        self.filter: Msckf | None = None
        self.restarts = 0
        self._imu = ImuBuffer(config.imu, 2.0 + motion_start.DURATION)
        self._last_pose = LastPose(start.configured_pose(p_WB, yaw))
        self._floor = floor
        self._views: deque[tuple[int, Features]] = deque()  # (exposure, features) at rest, not passed by the filter
        self._recent_views = RecentViews()
        self._gyro_bias: np.ndarray | None = None  # of the last filter whose biases may be true
        self._odometry: deque[OdometryState] | None = deque(maxlen=_KEPT_ODOMETRY)  # of the estimator; None from the first start on
        self._rotors: RotorState | None = None  # the newest
        self._at_rest = False
        self._noise_factor = 1.0  # variance of the IMU at rest over that of the sensor's noise, as last measured
        self._at_configured_start = True  # the vehicle has not left the configured start
        self._last_visual_update: int | None = None  # when vision last changed the state; None: not since the last rest
        self._frame = 0
        self._last_image = -1  # stamp of the last frame used, on the board's clock
        self._last_pixels = np.zeros(1, np.uint8)  # some of the last image's
        self._last_exposure: int | None = None
        self._last_update = 0  # when vision or rest last updated the filter
        self._observation_counts: deque[tuple[int, int]] = deque(maxlen=_DIVERGENCE_FRAMES)  # observations used and refused
        self._set_camera(mount)

    def _set_camera(self, mount: CameraMount) -> None:
        self.mount = mount
        self.tracker = Tracker(self.config.tracker, mount.camera)
        self._recent_views.clear()
        self._begin_motion_start()
        _compile(mount.camera)

    def use_camera(self, mount: CameraMount) -> None:
        """Switch to another camera or calibration: a filter in flight is dropped and restarted in motion."""
        if self._at_rest:
            self._store_pose()
            self.filter, self._at_rest = None, False  # nothing is lost: it still stands there
        elif self.filter is not None:
            self._drop_filter()
        else:
            self._last_pose.pose = self._last_pose.present()
        self._views.clear()
        self._set_camera(mount)

    def _begin_motion_start(self) -> None:
        """Begin to collect frames for a start in motion."""
        self._motion_start = motion_start.MotionStart(self.config, self.mount, self._gyro_bias)
        self._last_pose.begin_rotation(self._motion_start.gyro_bias)

    @property
    def has_imu(self) -> bool:
        """Whether there has been an IMU sample."""
        return self._imu.last is not None

    def has_left_start_before(self, stamp: int) -> bool:
        """Whether the vehicle has left the configured start, by samples that all precede a stamp [ns]."""
        last = self._imu.last  # None: no sample since `forget_start` could be used
        return not self._at_configured_start and (last is None or last.stamp < stamp)

    def forget_start(self, stamp: int) -> None:
        """Take position and heading for unknown, of a vehicle that may be in motion at a stamp [ns]; call it before the first sample."""
        self._last_pose.forget()
        self._last_pose.known_at, self._at_configured_start = (stamp, 0.0), False

    @property
    def gyro_sigma(self) -> float:
        """1 sigma of the newest gyro sample [rad/s]."""
        return self._imu.gyro_sigma

    @property
    def time_offset(self) -> float:
        """Middle of the exposure on the IMU's clock minus the image's stamp, as estimated [s]."""
        return self.filter.state.time_offset if self.filter else -self.mount.stamp_offset

    def covers(self, stamp: int) -> bool:
        """Whether the IMU has passed the exposure of an image with this stamp [ns], or the stamp is too far ahead to wait for."""
        newest = self._imu.last.stamp if self._imu.last else None
        exposure = stamp + round(self.time_offset * 1e9)
        return newest is not None and (exposure <= newest or exposure > newest + _MAX_STAMP_LEAD)

    @property
    def _running(self) -> Msckf:
        """The filter, which must have been started."""
        assert self.filter is not None
        return self.filter

    def add_imu(self, sample: ImuSample) -> ImuOutcome:
        """Store a sample; bad ones are bridged or refused, see `ImuOutcome`."""
        return self._imu.add(sample)

    def add_odometry(self, odometry: OdometryState) -> None:
        """Store odometry of the estimator, which a first start in flight continues; later odometry derives from this one."""
        if self._odometry is not None:
            self._odometry.append(odometry)

    def add_rotors(self, rotors: RotorState) -> None:
        """Store the state of the rotors: a vehicle with a quiet IMU rests where they stand."""
        self._rotors = rotors

    @property
    def _rotors_stand(self) -> bool | None:
        """Whether the rotors stand; None: not known."""
        return rotors_stand(self._rotors, self._imu.newest.stamp)

    def add_image(self, stamp: int, image: np.ndarray) -> VioResult:
        """Process a frame.

        Args:
            stamp: of the image, on the camera's clock [ns].
            image: grey, uint8 (height, width).
        """
        exposure = stamp + round(self.time_offset * 1e9)
        problem = self._problem(stamp, exposure, image)
        if problem is not None:
            return VioResult(problem, restarts=self.restarts, message=f"frame {stamp} ns {problem.value}")
        self._last_image = stamp
        if self._last_exposure is not None and self._last_exposure < self._imu.oldest:
            self._resume(exposure)
        features = self._track(image, exposure)
        self._frame += 1
        if self.filter is None:
            return self._try_start(exposure, features)
        try:
            return self._step(exposure, features)
        except np.linalg.LinAlgError:
            return self._lose(features, "covariance is not positive definite")

    def _problem(self, stamp: int, exposure: int, image: np.ndarray) -> FrameOutcome | None:
        camera = self.mount.camera
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width):
            return FrameOutcome.BAD_IMAGE
        if self._imu.last is None:
            return FrameOutcome.NO_IMU
        if stamp <= self._last_image or (self.filter and exposure <= self.filter.state.stamp):
            return FrameOutcome.NOT_NEWER
        if exposure > self._imu.last.stamp:
            return FrameOutcome.FUTURE
        last, self._last_pixels = self._last_pixels, image[::16, ::16].copy()
        in_motion = not self._at_rest and (self.filter is not None or self._last_pose.known_at is not None)
        if in_motion and np.array_equal(self._last_pixels, last) and np.count_nonzero(last != np.median(last)) > last.size // 100:
            return FrameOutcome.REPEATED  # in the dark all may be equal, but for hot pixels
        return FrameOutcome.TOO_OLD if exposure < self._imu.oldest else None

    def _resume(self, exposure: int) -> None:
        """Restart from the last known pose after a gap in the images that is longer than the IMU history.

        A vehicle that rested before the gap, and whose IMU is at rest after it, rests there still. Another may have turned by any angle.
        """
        rests = self._at_rest and is_at_rest(window(self._imu, exposure))
        moved = self._last_pose.known_at is not None or (self.filter is not None and not rests)
        if rests:
            self._store_pose()
            self._begin_motion_start()
            self.filter, self._at_rest, self._at_configured_start = None, False, False
        elif self.filter is not None:
            self._drop_filter(_UNSEEN_SPEED if self._at_rest else 0.0)
        if moved:
            self._last_pose.forget_heading()
        self.tracker.reset()
        self._recent_views.clear()
        self._views.clear()
        self._last_exposure = None

    def _track(self, image: np.ndarray, exposure: int) -> Features:
        state = self.filter.state if self.filter else None
        R_BC = state.R_BC if state else self.mount.R_BC
        turn, slack = np.eye(3), 0.0
        if self._last_exposure is not None:
            steps = self._imu.run(self._last_exposure, exposure)
            turn = preintegrate(steps, state.gyro_bias if state else self._motion_start.gyro_bias, np.zeros(3)).dR
            if state is None:
                self._last_pose.rotate(steps)
                slack = 2e-9 * self._motion_start.gyro_sigma * (exposure - self._last_exposure)
        self._last_exposure = exposure
        features = self.tracker.track(image, R_BC.T @ turn.T @ R_BC, slack)
        self._recent_views.add(exposure, features)
        return features

    # -- before the start --------------------------------------------------------------------------------------------

    def _try_start(self, exposure: int, features: Features) -> VioResult:
        """Start at rest or, when the vehicle moves, from the frames of the last half second or more.

        The pose is that of the estimator's odometry, where there is any: then the vehicle may be in flight.
        """
        self._take_odometry(exposure)
        steps = window(self._imu, exposure)
        if self._may_start_at_rest(steps):
            self._begin(start.at_rest(self.config, self.mount, exposure, steps,
                                      self._last_pose.present(steps[:, GYRO].mean(axis=0))))
            return self._hold(exposure, features)
        self._motion_start.add(self._frame, exposure, features.ids, observe(self.mount.camera, features.pixels))
        state = self._motion_start.solve(self._imu, self._last_pose.present)
        if state is not None:
            self._begin(state)
            self._at_configured_start, self._last_visual_update = False, exposure
            return self._result(FrameOutcome.TRACKING, features, FrameReport())
        outcome = FrameOutcome.LOST if self.restarts else FrameOutcome.INITIALISING
        return VioResult(outcome, None, len(features.ids), restarts=self.restarts, message=outcome.value)

    def _may_start_at_rest(self, steps: np.ndarray) -> bool:
        """Whether the last IMU steps (m, 9) and images are those of a vehicle at rest.

        With odometry, or after a loss in motion, it may hover, where for moments either looks like rest: the IMU must be quiet and
        the image static for long, or, without an image, the rotors stand. The biases of an earlier filter do not count: they may be
        why it was lost. Odometry that cannot be used leaves the configured start. A vehicle that rested before its camera was silent
        or replaced may have left: what the image shows, it must show for long. A vehicle that has not moved needs no evidence without
        an image, unless its rotors turn.
        """
        for_long, moving = self._recent_views.is_static(STATIC_DURATION), self._last_pose.known_at is not None
        stand = self._rotors_stand
        unseen = stand or (stand is None and not moving)
        if moving or self._odometry:
            return bool(unseen if for_long is None else for_long) and is_at_rest(steps)
        static = self._recent_views.is_static() if self._at_configured_start else for_long
        return bool(unseen if static is None else static) and is_at_rest(steps, image_is_static=bool(for_long))

    def _take_odometry(self, exposure: int) -> None:
        """Make the newest odometry before an exposure the known pose."""
        odometry = next((o for o in reversed(self._odometry or ()) if self._imu.oldest <= o.stamp < exposure), None)
        if odometry is None:
            return
        pose = pose_of(odometry)
        if pose.problem() is None:
            self._last_pose.pose, self._at_configured_start = start.odometry_pose(pose), False
            self._last_pose.known_at = pose.stamp, float(np.linalg.norm(odometry.v_B))
            self._last_pose.begin_rotation(self._motion_start.gyro_bias)
            self._last_pose.rotate(self._imu.run(pose.stamp, exposure))

    def _begin(self, state: at.State) -> None:
        self._last_pose.propagate_position(state, self._imu)
        self.filter = Msckf(self.config, state, self.mount.camera.fx)
        self._last_update = state.stamp
        self._odometry = None
        self._observation_counts.clear()

    # -- afterwards --------------------------------------------------------------------------------------------------

    def _step(self, exposure: int, features: Features) -> VioResult:
        if self._is_at_rest(exposure):
            return self._hold(exposure, features)
        filter = self._running
        if self._at_rest and self._at_configured_start and self._floor is not None and not filter.state.landmarks:
            self._add_ground_landmarks(self._floor, features)
        self._at_rest = False
        filter.propagate(self._imu.run(filter.state.stamp, exposure), exposure)
        report = filter.add_frame(self._frame, features.ids, self._observe(features))
        if report.used:
            self._last_visual_update, self._at_configured_start = exposure, False
        return self._check_divergence(exposure, features, report)

    def _is_at_rest(self, exposure: int) -> bool:
        """Whether the vehicle rests: the IMU is quiet, nothing moves in the image, and the filter's velocity may be zero.

        False until `_MAX_BLIND_NO_TRACKS` after a visual update: a very quiet hover looks like rest. A rest therefore begins only with
        evidence beyond the IMU: an image that is static for long, or rotors that stand. Where IMU samples are missing, a vehicle that
        rested before rests still if the images since have not moved.
        """
        if self._last_visual_update is not None and exposure - self._last_visual_update < round(1e9 * _MAX_BLIND_NO_TRACKS):
            return False
        state, steps = self._running.state, window(self._imu, exposure)
        quiet, for_long = self._recent_views.is_static(), bool(self._recent_views.is_static(STATIC_DURATION))
        if self._at_rest and quiet and len(without_gaps(steps)) < len(steps):
            return for_long
        evidence = for_long or self._rotors_stand
        if not self._at_rest and not (evidence and rest.velocity_may_be_zero(state)):
            return False
        return quiet is not False and is_at_rest(steps, *_biases(state), image_is_static=bool(quiet) and (self._at_rest or for_long))

    def _is_leaving(self, exposure: int) -> bool:
        """Whether the velocity is still known from the last rest: no visual update since, which was a moment ago."""
        return (self._last_visual_update is None and (exposure - self._last_update) * 1e-9 < _MAX_BLIND_TAKE_OFF
                and velocity_sigma(self._running.state) < _MAX_TAKE_OFF_SIGMA)

    def _hold(self, exposure: int, features: Features) -> VioResult:
        """Update the filter with rest, up to `_REST_DELAY` before the exposure.

        A take-off is detected some time after its beginning. Due to the lag, the rest applied so far remains true, and the filter
        catches up with the IMU when the vehicle leaves. The result at the exposure is its state propagated by the IMU since.
        """
        filter, state = self._running, self._running.state
        until = max(state.stamp, exposure - round(_REST_DELAY * 1e9))
        if not self._at_rest:
            filter.propagate(self._imu.run(state.stamp, until), until)
            rest.stop(filter)
            self._at_rest, self._last_visual_update = True, None
            self._views.clear()
        steps, latest = self._imu.run(state.stamp, until), window(self._imu, exposure)
        if len(without_gaps(latest)) == len(latest):
            self._noise_factor = max(1.0, energy(latest))
        if len(steps):
            rest.hold(filter, steps, until, self._noise_factor)
        self._last_update = exposure
        self._views.append((exposure, features))
        while len(self._views) > 1 and self._views[1][0] <= state.stamp:
            self._views.popleft()
        return self._result(FrameOutcome.RESTING, features, FrameReport(),
                            rest.propagated_to(filter, self._imu.run(until, exposure, sensor_noise=True), exposure, self._noise_factor))

    def _add_ground_landmarks(self, floor: float, features: Features) -> None:
        """Make ground features that were seen at rest, and still are, the first landmarks."""
        exposure, view = self._views[0]
        if exposure > self._running.state.stamp:
            return
        known = np.isin(view.ids, features.ids)
        known[len(view.ids) - view.new:] = False
        ground.add_ground_landmarks(self._running, view.ids[known], self._observe(view).chosen(known), floor)

    def _observe(self, features: Features) -> Bearings:
        """Return bearings; 1 sigma of each is the larger of the camera's `track` and the patch fit's by image noise."""
        return replace(observe(self.mount.camera, features.pixels),
                       noise=np.maximum(features.sigma / self.config.calibration.track, 1.0))

    def _check_divergence(self, exposure: int, features: Features, report: FrameReport) -> VioResult:
        """Return the frame's result, after a check for divergence and for missing visual updates."""
        s = self._running.state
        if report.used:
            self._last_update = exposure
        self._observation_counts.append((report.used, report.refused))
        used, refused = np.sum(self._observation_counts, axis=0)
        why = divergence(s, used, refused, len(self._observation_counts))
        if why:
            return self._lose(features, why)
        blind = (exposure - self._last_update) * 1e-9
        outcome = FrameOutcome.TRACKING
        if blind > (_MAX_BLIND if len(features.ids) - features.new >= MIN_TRACKS else _MAX_BLIND_NO_TRACKS):
            # in the first decimetres the floor is a blur; the standstill's knowledge carries the vehicle over them
            outcome = FrameOutcome.LEAVING if self._is_leaving(exposure) else FrameOutcome.BLIND
        return self._result(outcome, features, report)

    def _lose(self, features: Features, why: str) -> VioResult:
        """Store the known position and heading, and restart in motion."""
        self._drop_filter()
        return VioResult(FrameOutcome.LOST, None, len(features.ids), restarts=self.restarts, message=f"lost: {why}")

    def _drop_filter(self, least_speed: float = 0.0) -> None:
        self._store_pose()
        s = self._running.state
        speed = max(float(np.linalg.norm(s.v_WB)), least_speed)
        self._last_pose.known_at = s.stamp, speed if speed < SPEED_MAX else SPEED_MAX
        self._begin_motion_start()
        self.filter, self._at_rest, self._at_configured_start, self.restarts = None, False, False, self.restarts + 1

    def _store_pose(self) -> None:
        """Store pose and gyro bias for a new start.

        A pose that is not finite is unknown from now on; biases beyond any sensor's are not stored.
        """
        s = self._running.state
        if np.isfinite(s.P).all() and np.isfinite(s.p_WB).all() and np.isfinite(s.R_WB).all():
            self._last_pose.pose = KnownPose(s.p_WB.copy(), s.R_WB.copy(), start.positive(_estimate(s).pose_covariance[start.POSE_ROWS]))
        else:
            self._last_pose.forget()
        if np.linalg.norm(s.gyro_bias) < MAX_GYRO_BIAS and np.linalg.norm(s.accel_bias) < MAX_ACCEL_BIAS:
            self._gyro_bias = s.gyro_bias.copy()

    def _result(self, outcome: FrameOutcome, features: Features, report: FrameReport, now: at.State | None = None) -> VioResult:
        """Return a frame's result; `now`: the state at its exposure; None: the filter's state."""
        s = self._running.state if now is None else now
        return VioResult(outcome, _estimate(s) if outcome.has_pose else None, len(features.ids), report.used, report.refused,
                         report.nis, report.nis_dimension, (s.stamp - self._last_update) * 1e-9, self.restarts, outcome.value)


def _estimate(s: at.State) -> VioPoseEstimate:
    return VioPoseEstimate(s.stamp, s.p_WB.copy(), s.R_WB.copy(), s.v_WB.copy(), s.w_WB_B.copy(), s.gyro_bias.copy(),
                           s.accel_bias.copy(), s.P[np.ix_(_INERTIAL, _INERTIAL)])


def _biases(state: at.State) -> tuple[np.ndarray, np.ndarray]:
    """Return the biases of gyro and accelerometer, and their variances, shape (6,)."""
    return np.concatenate([state.gyro_bias, state.accel_bias]), np.abs(np.diag(state.P)[9:15])


def _compile(camera: Camera) -> None:
    """Run the compiled functions once: their first compilation takes seconds, which must not happen in flight."""
    row = np.array([[0.002, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81, 1e-4, 0.1]])
    preintegrate(row, np.zeros(3), np.zeros(3))
    rays = np.array([[0.0, 0.0, -1.0], [-0.6, 0.0, -0.8]])
    centres = np.array([[0.0, 0.0, 1.0], [0.75, 0.0, 1.0]])
    X = triangulate(centres, rays, 0.1, 0.01)
    seen = observe(camera, camera.project(np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]))[0])
    linear = residuals(np.broadcast_to(np.eye(3), (2, 3, 3)), centres, np.array([X, X]), np.eye(3), np.zeros(3), seen)
    ekf.eliminate(linear.J[:, :, :POINT.start].reshape(4, -1), linear.J[:, :, POINT].reshape(4, 3), linear.r.ravel())
