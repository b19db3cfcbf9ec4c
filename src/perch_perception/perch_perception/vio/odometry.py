"""Visual-inertial odometry: IMU samples and images in, poses with covariance out. [M:IV-B]

Connects tracker and filter and decides the outcome of each frame: waiting for a start, standing still, tracking, blind, or
lost. Independent of ROS; the same inputs give the same outputs.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from perch_core import so3
from perch_core.camera import Camera
from perch_core.camera_mount import CameraMount
from perch_core.values import ImuSample
from perch_perception.ukf.imu_buffer import ImuBuffer, ImuOutcome
from perch_perception.ukf.stillness import energy, still, window
from perch_perception.ukf.unscented import GYRO
from perch_perception.vio import ekf, ground, motion_start, rest, start
from perch_perception.vio import state as at
from perch_perception.vio.bearing import POINT, Bearings, observe, residuals
from perch_perception.vio.config import VioConfig
from perch_perception.vio.divergence import SPEED_MAX, divergence, velocity_sigma
from perch_perception.vio.msckf import FrameReport, Msckf
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.recent_views import LEAST_TRACKS, STANDS, RecentViews
from perch_perception.vio.result import FrameOutcome, VioPoseEstimate, VioResult
from perch_perception.vio.start import KnownPose
from perch_perception.vio.tracker import Features, Tracker
from perch_perception.vio.triangulation import triangulate

_REST_LAG = 0.25  # the filter stays this far behind while it stands still [s]
_DARK = 0.15  # time without a visual update that is blindness where nothing is tracked [s]
_BLIND = 0.5  # the same whatever is tracked [s]
_LEAVING = 1.0  # from rest on, in which a take-off may go on blind [s]
_LEAVING_VELOCITY = 0.05  # 1 sigma up to which it may [m/s]
_FATES = 15  # frames over which observations that are refused and used are counted
_FUTURE = 500_000_000  # an image this far ahead of the IMU cannot be right [ns]
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
        self._known = start.told(p_WB, yaw)
        self._floor = floor
        self._views: deque[tuple[int, Features]] = deque()  # (exposed, features) of frames at rest that the filter has not passed
        self._seen = RecentViews()
        self._biases: tuple[np.ndarray, np.ndarray] | None = None  # of gyro and accelerometer (6,) and their variances, of the last filter
        self._lost: tuple[int, float] | None = None  # when the last filter ended, and how fast it was [ns, m/s]
        self._resting = False
        self._told = True     # it stands where it was told to start
        self._sight: int | None = None  # when vision last changed the state; None: not since the last rest
        self._frame = 0
        self._last_image = -1           # stamp of the last frame used, on the board's clock
        self._last_exposed: int | None = None
        self._informed = 0              # when vision or rest last updated the filter
        self._fates: deque[tuple[int, int]] = deque(maxlen=_FATES)  # observations used and refused
        self._look_through(mount)

    def _look_through(self, mount: CameraMount) -> None:
        self.mount = mount
        self.tracker = Tracker(self.config.tracker, mount.camera)
        self._seen.clear()
        self._await()
        _compile(mount.camera)

    def use_camera(self, mount: CameraMount) -> None:
        """Switch to another camera or calibration: a filter in flight is dropped and restarted in motion."""
        if self._resting:
            self._know()
            self.filter, self._resting = None, False  # nothing is lost: it still stands there
        elif self.filter is not None:
            self._forget_state()
        else:
            self._known = self._known_with(self._turned_bias)
        self._views.clear()
        self._look_through(mount)

    def _await(self) -> None:
        """Begin to collect frames for a start in motion."""
        self._moving = motion_start.MotionStart(self.config, self.mount, None if self._biases is None else self._biases[0][:3])
        # rotation since the pose was known, by the gyro less a bias, and its derivative by that
        self._turned, self._turned_bias = (np.eye(3), np.zeros((3, 3))), self._moving.gyro_bias

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
        exposed = stamp + round(self.time_offset * 1e9)
        return newest is not None and (exposed <= newest or exposed > newest + _FUTURE)

    @property
    def _running(self) -> Msckf:
        """The filter, which must have been started."""
        assert self.filter is not None
        return self.filter

    def add_imu(self, sample: ImuSample) -> ImuOutcome:
        """Store a sample; bad ones are bridged or refused, see `ImuOutcome`."""
        return self._imu.add(sample)

    def add_image(self, stamp: int, image: np.ndarray) -> VioResult:
        """Process a frame.

        Args:
            stamp: of the image, on the camera's clock [ns].
            image: grey, uint8 (height, width).
        """
        exposed = stamp + round(self.time_offset * 1e9)
        problem = self._problem(stamp, exposed, image)
        if problem is not None:
            return VioResult(problem, restarts=self.restarts, message=f"frame {stamp} ns {problem.value}")
        self._last_image = stamp
        if self._last_exposed is not None and self._last_exposed < self._imu.oldest:
            self._resume()
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
        return FrameOutcome.TOO_OLD if exposed < self._imu.oldest else None

    def _resume(self) -> None:
        """Restart from the last known pose after a gap in the images that is longer than the IMU history.

        A vehicle at rest is assumed to rest there still. One in motion may have turned by any angle.
        """
        moved = self._lost is not None or (self.filter is not None and not self._resting)
        if self.filter is not None:
            self._forget_state()
        if moved:
            covariance = self._known.covariance.copy()
            covariance[3, :3] = covariance[:3, 3] = 0.0
            covariance[3, 3] = np.pi**2 / 3.0  # all headings alike
            self._known = replace(self._known, covariance=covariance)
        self.tracker.reset()
        self._seen.clear()
        self._views.clear()
        self._last_exposed = None

    def _track(self, image: np.ndarray, exposed: int) -> Features:
        state = self.filter.state if self.filter else None
        R_BC = state.R_BC if state else self.mount.R_BC
        turn, slack = np.eye(3), 0.0
        if self._last_exposed is not None:
            steps = self._imu.run(self._last_exposed, exposed)
            turn = preintegrate(steps, state.gyro_bias if state else self._moving.gyro_bias, np.zeros(3)).dR
            if state is None:
                part = preintegrate(steps, self._turned_bias, np.zeros(3))
                self._turned = self._turned[0] @ part.dR, part.dR.T @ self._turned[1] + part.J[:3, :3]
                slack = 2e-9 * self._moving.gyro_sigma * (exposed - self._last_exposed)
        features = self.tracker.track(image, R_BC.T @ turn.T @ R_BC, slack)
        self._seen.add(exposed, features)
        return features

    # -- before the start --------------------------------------------------------------------------------------------

    def _try_start(self, exposed: int, features: Features) -> VioResult:
        """Start at rest or, when the vehicle moves, from the frames of the last half second or more."""
        steps = window(self._imu, exposed)
        biases, variance = self._biases or (None, None)
        if self._seen.still() is not False and still(steps, biases, variance, bool(self._seen.still(STANDS))):
            self._begin(start.at_rest(self.config, self.mount, exposed, steps, self._known_with(steps[:, GYRO].mean(axis=0))))
            return self._hold(exposed, features)
        self._moving.add(self._frame, exposed, features.ids, observe(self.mount.camera, features.pixels))
        state = self._moving.solve(self._imu, self._known_with)
        if state is not None:
            self._begin(state)
            self._told, self._sight = False, exposed
            return self._result(FrameOutcome.TRACKING, features, FrameReport())
        outcome = FrameOutcome.LOST if self.restarts else FrameOutcome.INITIALISING
        return VioResult(outcome, None, len(features.ids), restarts=self.restarts, message=outcome.value)

    def _known_with(self, gyro_bias: np.ndarray) -> KnownPose:
        """Return the known present pose, with the heading propagated by the gyro less this bias."""
        dR, J = self._turned
        return replace(self._known, R_WB=self._known.R_WB @ dR @ so3.exp(J @ (gyro_bias - self._turned_bias)))

    def _begin(self, state: at.State) -> None:
        if self._lost is not None:
            since, speed = self._lost
            if since >= self._imu.oldest:
                start.carry(state, preintegrate(self._imu.run(since, state.stamp), state.gyro_bias, state.accel_bias))
            else:  # it has moved since by nobody knows what
                reach = 1e-9 * (state.stamp - since) * max(speed, float(np.linalg.norm(state.v_WB)))
                state.P[at.POSITION, at.POSITION] += reach**2 * np.eye(3)
            self._lost = None
        self.filter = Msckf(self.config, state, self.mount.camera.fx)
        self._informed = state.stamp
        self._fates.clear()

    # -- afterwards --------------------------------------------------------------------------------------------------

    def _step(self, exposed: int, features: Features) -> VioResult:
        if self._is_still(exposed):
            return self._hold(exposed, features)
        filter = self._running
        if self._resting and self._told and self._floor is not None and not filter.state.landmarks:
            self._stand_on(self._floor, features)
        self._resting = False
        filter.propagate(self._imu.run(filter.state.stamp, exposed), exposed)
        report = filter.add_frame(self._frame, features.ids, self._observe(features))
        if report.used:
            self._sight, self._told = exposed, False
        return self._judge(exposed, features, report)

    def _is_still(self, exposed: int) -> bool:
        """Whether the vehicle rests: the IMU is quiet, nothing moves in the image, and the filter's velocity may be zero.

        False until `_DARK` after a visual update: a very quiet hover looks like rest.
        """
        state = self._running.state
        if self._sight is not None and exposed - self._sight < round(1e9 * _DARK):
            return False
        quiet = self._seen.still()
        return (quiet is not False and (self._resting or rest.can_stand(state))
                and still(window(self._imu, exposed), *_biases(state),
                          seen=bool(quiet) and (self._resting or bool(self._seen.still(STANDS)))))

    def _hold(self, exposed: int, features: Features) -> VioResult:
        """Update the filter with rest, up to `_REST_LAG` before the exposure.

        A take-off is detected some time after its beginning. Due to the lag, the rest applied so far remains true, and the filter
        catches up with the IMU when the vehicle leaves. The result at the exposure is its state propagated by the IMU since.
        """
        filter, state = self._running, self._running.state
        until = max(state.stamp, exposed - round(_REST_LAG * 1e9))
        if not self._resting:
            filter.propagate(self._imu.run(state.stamp, until), until)
            rest.stop(filter)
            self._resting, self._sight = True, None
            self._views.clear()
        steps, shaken = self._imu.run(state.stamp, until), max(1.0, energy(window(self._imu, exposed)))
        if len(steps):
            rest.hold(filter, steps, until, shaken)
        self._informed = exposed
        self._views.append((exposed, features))
        while len(self._views) > 1 and self._views[1][0] <= state.stamp:
            self._views.popleft()
        return self._result(FrameOutcome.RESTING, features, FrameReport(), rest.moved_on(filter, self._imu.run(until, exposed), exposed, shaken))

    def _stand_on(self, floor: float, features: Features) -> None:
        """Make ground features that were seen at rest, and still are, the first landmarks."""
        exposed, view = self._views[0]
        if exposed > self._running.state.stamp:
            return
        known = np.isin(view.ids, features.ids)
        known[len(view.ids) - view.new:] = False
        ground.take_in(self._running, view.ids[known], self._observe(view).chosen(known), floor)

    def _observe(self, features: Features) -> Bearings:
        """Return bearings; 1 sigma of each is the larger of the configured `pixel_noise` and the patch fit's by image noise."""
        return replace(observe(self.mount.camera, features.pixels),
                       noise=np.maximum(features.sigma / self.config.filter.pixel_noise, 1.0))

    def _judge(self, exposed: int, features: Features, report: FrameReport) -> VioResult:
        """Return the frame's result, after a check for divergence and for missing visual updates."""
        s = self._running.state
        if report.used:
            self._informed = exposed
        self._fates.append((report.used, report.refused))
        used, refused = np.sum(self._fates, axis=0)
        why = divergence(s, used, refused, len(self._fates))
        if why:
            return self._lose(features, why)
        blind = (exposed - self._informed) * 1e-9
        outcome = FrameOutcome.TRACKING
        if blind > (_BLIND if len(features.ids) - features.new >= LEAST_TRACKS else _DARK):
            # in the first decimetres the floor is a blur; the standstill's knowledge carries the vehicle over them
            leaving = self._sight is None and blind < _LEAVING and velocity_sigma(s) < _LEAVING_VELOCITY
            outcome = FrameOutcome.LEAVING if leaving else FrameOutcome.BLIND
        return self._result(outcome, features, report)

    def _lose(self, features: Features, why: str) -> VioResult:
        """Store the known position and heading, and restart in motion."""
        self._forget_state()
        return VioResult(FrameOutcome.LOST, None, len(features.ids), restarts=self.restarts, message=f"lost: {why}")

    def _forget_state(self) -> None:
        self._know()
        s = self._running.state
        speed = float(np.linalg.norm(s.v_WB))
        self._lost = s.stamp, speed if speed < SPEED_MAX else SPEED_MAX
        self._await()
        self.filter, self._resting, self._told, self.restarts = None, False, False, self.restarts + 1

    def _know(self) -> None:
        """Store the pose and biases for a new start, unless they are not finite."""
        s = self._running.state
        if np.isfinite(s.P).all() and np.isfinite(s.p_WB).all():
            rows = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])
            self._known = KnownPose(s.p_WB.copy(), s.R_WB.copy(), _estimate(s).pose_covariance[rows])
            self._biases = _biases(s)

    def _result(self, outcome: FrameOutcome, features: Features, report: FrameReport, now: at.State | None = None) -> VioResult:
        """Return a frame's result; `now`: the state at its exposure; None: the filter's state."""
        s = self._running.state if now is None else now
        return VioResult(outcome, _estimate(s) if outcome.has_pose else None, len(features.ids), report.used, report.refused,
                         report.nis, report.nis_dimension, (s.stamp - self._informed) * 1e-9, self.restarts, outcome.value)


def _estimate(s: at.State) -> VioPoseEstimate:
    return VioPoseEstimate(s.stamp, s.p_WB.copy(), s.R_WB.copy(), s.v_WB.copy(), s.w_WB_B.copy(), s.gyro_bias.copy(),
                           s.accel_bias.copy(), s.P[np.ix_(_INERTIAL, _INERTIAL)])


def _biases(state: at.State) -> tuple[np.ndarray, np.ndarray]:
    """Return the biases of gyro and accelerometer, and their variances, shape (6,)."""
    return np.concatenate([state.gyro_bias, state.accel_bias]), np.diag(state.P)[9:15].copy()


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
