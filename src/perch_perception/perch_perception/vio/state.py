"""The state of the MSCKF: inertial state, calibration, a sliding window of poses, landmarks, and their covariance.

Error vector: theta, p, v, b_g, b_a (15) | camera rotation, camera position, time offset (7), lens (log fx, log fy,
cx / fx, cy / fy) | clones (theta, p) | landmarks (X). Attitude errors are right perturbations, R_WB = R exp(theta),
R_BC = R exp(theta_c).

Jacobians are evaluated at the newest poses, and the covariance is transformed when an update moves these (`State.inject`), so
that yaw and position in W remain unobservable for the filter, as they are in fact (docs/estimation.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from perch_core import so3
from perch_core.jit import compiled

from perch_perception.vio import camera_frame

THETA, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCEL_BIAS = slice(9, 12), slice(12, 15)
CAMERA_ROTATION, CAMERA_POSITION, TIME_OFFSET, LENS = slice(15, 18), slice(18, 21), 21, slice(22, 26)
INERTIAL_SIZE, CORE_SIZE, CLONE_SIZE = 15, 26, 6
_CAMERA = np.r_[THETA, POSITION, CAMERA_ROTATION, CAMERA_POSITION]  # what a point's place in the camera depends on


@compiled
def _symmetrise(P):
    """Replace P by (P + P^T) / 2."""
    for r in range(len(P)):
        for c in range(r):
            P[r, c] = P[c, r] = 0.5 * (P[r, c] + P[c, r])


@compiled
def _transform_covariance(P, direction, scale):
    """Replace P by M P M^T with M = I + direction scale^T, both vectors of shape (n,)."""
    q = P @ scale
    variance = scale @ q
    for r in range(len(P)):
        for c in range(r + 1):
            P[r, c] = P[r, c] + direction[r] * q[c] + q[r] * direction[c] + variance * direction[r] * direction[c]
            P[c, r] = P[r, c]


@dataclass
class Clone:
    """A past pose of the body: R_WB (3, 3), p_WB (3,)."""

    frame: int
    R_WB: np.ndarray
    p_WB: np.ndarray


@dataclass
class Landmark:
    """A point in the state: position in W (3,), number of consecutive refusals."""

    X_W: np.ndarray
    consecutive_refusals: int = 0


@dataclass
class State:
    """State of one `Msckf`, which owns it. `w_WB_B` is the newest angular velocity, bias removed [rad/s], shape (3,)."""

    stamp: int
    R_WB: np.ndarray
    p_WB: np.ndarray
    v_WB: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_BC: np.ndarray
    p_BC: np.ndarray
    time_offset: float
    P: np.ndarray
    w_WB_B: np.ndarray = field(default_factory=lambda: np.zeros(3))
    clones: list[Clone] = field(default_factory=list)
    landmarks: dict[int, Landmark] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Dimension of the error."""
        return len(self.P)

    @property
    def landmark_start(self) -> int:
        """Index of the first landmark in the error."""
        return CORE_SIZE + CLONE_SIZE * len(self.clones)

    def clone_at(self, j: int) -> int:
        """Index of clone j in the error."""
        return CORE_SIZE + CLONE_SIZE * j

    def inject(self, dx: np.ndarray) -> None:
        """Add an error estimate, shape (size,), to the state, and transform the covariance.

        An update leaves the errors unchanged as seen from W, R theta and dp + p x (R theta): there, a common rotation about the
        vertical is the same whatever the estimate. So with a step s from p to p', and from R to R',

            theta := R'^T R theta,   dp := dp - s x (R theta),

        likewise v with the present theta, each clone with its own. Otherwise the unobservable direction would change with each
        step, and the filter would gain information on it from its own corrections. A point's error is kept constant as seen from
        the camera, in direction and log distance (`camera_frame`), and the step moves the point in these coordinates: the
        camera's rotation on the body and a distance are hardly observable either.

        The direction of a change of scale (`scale_direction`) depends on the estimate as well, and is transformed with it.
        """
        direction = self.scale_direction()
        transport = self._move(dx)
        transport(self.P)
        transport(self.P.T)
        _symmetrise(self.P)
        scale = self.scale_error()
        if scale is not None:
            transport(direction[:, None])
            _transform_covariance(self.P, self.scale_direction() - direction, scale / (scale @ direction))

    def _move(self, dx: np.ndarray) -> Callable[[np.ndarray], None]:
        """Move all estimates; return the function that transforms errors accordingly, in place, in an array of shape (size, n)."""
        start, marks = self.landmark_start, list(self.landmarks.values())
        where = np.array([0, *map(self.clone_at, range(len(self.clones)))])[:, None] + np.arange(CLONE_SIZE)
        R, steps = np.array([self.R_WB, *(c.R_WB for c in self.clones)]), dx[where]
        turns = so3.exp(np.vstack([steps[:, :3], dx[CAMERA_ROTATION]]))
        E, E_BC = turns[:-1], turns[-1]
        poses = np.zeros((len(where), CLONE_SIZE, CLONE_SIZE))
        poses[:, :3, :3], poses[:, 3:, 3:], poses[:, 3:, :3] = E.transpose(0, 2, 1), np.eye(3), -so3.hat(steps[:, 3:]) @ R
        velocity = so3.hat(dx[VELOCITY]) @ self.R_WB
        before = self._to_camera(np.array([m.X_W for m in marks]).reshape(-1, 3))
        X_C, S = camera_frame.moved(before.X_C, before.by_camera @ dx[_CAMERA] + dx[start:].reshape(-1, 3) @ before.R_CW.T)

        R = R @ E
        self.R_WB, self.p_WB, self.v_WB = R[0], self.p_WB + dx[POSITION], self.v_WB + dx[VELOCITY]
        for clone, R_WB, step in zip(self.clones, R[1:], steps[1:]):
            clone.R_WB, clone.p_WB = R_WB, clone.p_WB + step[3:]
        self.gyro_bias = self.gyro_bias + dx[GYRO_BIAS]
        self.w_WB_B = self.w_WB_B - dx[GYRO_BIAS]
        self.accel_bias = self.accel_bias + dx[ACCEL_BIAS]
        self.R_BC = self.R_BC @ E_BC
        self.p_BC = self.p_BC + dx[CAMERA_POSITION]
        self.time_offset += float(dx[TIME_OFFSET])
        X_W = self.p_WB + (self.p_BC + X_C @ self.R_BC.T) @ self.R_WB.T
        for mark, X in zip(marks, X_W):
            mark.X_W = X
        by_camera, by_moved, by_point = camera_frame.error_transport(before, self._to_camera(X_W), S)

        def transport(rows: np.ndarray) -> None:
            camera, points = rows[_CAMERA], rows[start:].reshape(len(marks), 3, rows.shape[1])
            rows[VELOCITY] -= velocity @ camera[:3]
            rows[where] = poses @ rows[where]
            rows[CAMERA_ROTATION] = E_BC.T @ camera[6:9]
            rows[start:] = by_camera @ camera - by_moved @ rows[_CAMERA] + (by_point @ points).reshape(-1, rows.shape[1])

        return transport

    def _to_camera(self, X_W: np.ndarray) -> camera_frame.CameraPoints:
        return camera_frame.transform_to_camera(self.R_WB, self.p_WB, self.R_BC, self.p_BC, X_W)

    def scale_error(self) -> np.ndarray | None:
        """Return the gradient of s = scale^T dx, the relative deficit of all lengths: the mean over the landmarks of d ln |X_C|.

        A camera alone does not observe a common scale of its own path c = p + R p_BC and of the points,
        N_s = (.. c_k, v + R (w x p_BC), X ..), scale^T N_s = 1 except for the origin. It does observe a scale of the body's
        path, by p_BC / |X_C|, unless it is at the body's centre. s does not depend on position and yaw.

        Returns:
            Shape (size,); None with fewer than three landmarks.
        """
        if len(self.landmarks) < 3:
            return None
        seen = self._to_camera(np.array([m.X_W for m in self.landmarks.values()]))
        by_X_C = seen.X_C / (seen.X_C**2).sum(axis=1, keepdims=True) / len(seen.X_C)
        out = np.zeros(self.size)
        out[_CAMERA] = np.einsum("mi,mij->j", by_X_C, seen.by_camera)
        out[self.landmark_start :] = (by_X_C @ seen.R_CW).ravel()
        return out

    def scale_direction(self) -> np.ndarray:
        """Return the change of the state per scale of the camera's path and of the points (`scale_error`), shape (size,)."""
        out = np.zeros(self.size)
        out[POSITION] = self.p_WB + self.R_WB @ self.p_BC
        out[VELOCITY] = self.v_WB + self.R_WB @ so3.cross(self.w_WB_B, self.p_BC)
        if self.clones:
            R, p = self.window()
            out[CORE_SIZE : self.landmark_start].reshape(-1, CLONE_SIZE)[:, 3:] = p + R @ self.p_BC
        if self.landmarks:
            out[self.landmark_start :] = np.concatenate([m.X_W for m in self.landmarks.values()])
        return out

    def add_landmark(self, number: int, X_W: np.ndarray, step: np.ndarray, cross: np.ndarray, own: np.ndarray) -> None:
        """Add a point to the state.

        Args:
            number: of its feature.
            X_W: linearisation point, shape (3,).
            step: from there to the estimate, shape (3,).
            cross: covariance of its error with the state's, shape (3, size).
            own: its covariance, shape (3, 3).
        """
        before = self._to_camera(X_W[None])
        X_C, S = camera_frame.moved(before.X_C, (before.R_CW @ step)[None])
        X_W = self.p_WB + self.R_WB @ (self.p_BC + self.R_BC @ X_C[0])
        by_camera, by_moved, by_point = camera_frame.error_transport(before, self._to_camera(X_W[None]), S)
        by_camera, by_point = by_camera - by_moved, by_point[0]
        moved = by_camera @ self.P[_CAMERA] + by_point @ cross
        own = by_camera @ moved[:, _CAMERA].T + by_point @ (cross[:, _CAMERA] @ by_camera.T + own @ by_point.T)
        self.P = np.block([[self.P, moved.T], [moved, own]])
        self.landmarks[number] = Landmark(X_W)

    def add_clone(self, frame: int) -> None:
        """Copy the present pose into the window.

        The pose belongs to stamp + time_offset: an error of the offset moves it along the motion, which makes the offset
        observable.

        Args:
            frame: number of the frame.
        """
        n, at = self.size, self.landmark_start
        J = np.zeros((CLONE_SIZE, n))
        J[:3, THETA] = J[3:, POSITION] = np.eye(3)
        J[:3, TIME_OFFSET], J[3:, TIME_OFFSET] = self.w_WB_B, self.v_WB
        JP = J @ self.P
        P, before, new, after = np.empty((n + 6, n + 6)), slice(0, at), slice(at, at + 6), slice(at + 6, n + 6)
        for rows, old in ((before, slice(0, at)), (after, slice(at, n))):
            P[rows, before], P[rows, after] = self.P[old, :at], self.P[old, at:]
            P[new, rows], P[rows, new] = JP[:, old], JP[:, old].T
        P[new, new] = JP @ J.T
        self.P = P
        self.clones.append(Clone(frame, self.R_WB.copy(), self.p_WB.copy()))

    def drop_clones(self, which: list[int]) -> None:
        """Marginalise clones: remove their rows and columns from the covariance."""
        gone = set(which)
        if gone:
            rows = np.concatenate([np.arange(self.clone_at(j), self.clone_at(j) + 6) for j in gone])
            self._keep(np.delete(np.arange(self.size), rows))
            self.clones = [c for j, c in enumerate(self.clones) if j not in gone]

    def drop_landmarks(self, which: set[int]) -> None:
        """Marginalise landmarks."""
        if which:
            gone = [k for k, name in enumerate(self.landmarks) if name in which]
            rows = np.concatenate([np.arange(3) + self.landmark_start + 3 * k for k in gone])
            self._keep(np.delete(np.arange(self.size), rows))
            for name in which:
                self.landmarks.pop(name, None)

    def _keep(self, rows: np.ndarray) -> None:
        self.P = self.P[np.ix_(rows, rows)]

    def window(self) -> tuple[np.ndarray, np.ndarray]:
        """Present estimates of the clones: R_WB (n, 3, 3), p_WB (n, 3)."""
        return np.array([c.R_WB for c in self.clones]), np.array([c.p_WB for c in self.clones])
