"""The state of the MSCKF: inertial state, calibration, a sliding window of poses, landmarks, and their covariance.

Error vector: theta, p, v, b_g, b_a (15) | camera rotation, camera position, time offset, focal (8) | clones
(theta, p) | landmarks (X). Attitude errors are right perturbations, R_WB = R exp(theta), R_BC = R exp(theta_c).

Each linearised quantity keeps its *first estimate* (`*_first`): Jacobians of the window and of landmarks are taken
there, so that yaw and position in W stay unobservable for the filter, as they are (FEJ; docs/estimation.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from perch_core import so3

THETA, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCEL_BIAS = slice(9, 12), slice(12, 15)
CAMERA_ROTATION, CAMERA_POSITION, TIME_OFFSET, FOCAL = slice(15, 18), slice(18, 21), 21, 22
INERTIAL_SIZE, CORE_SIZE, CLONE_SIZE = 15, 23, 6


@dataclass
class Clone:
    """A past pose of the body: R_WB (3, 3), p_WB (3,), both also as first estimated."""

    frame: int
    R_WB: np.ndarray
    p_WB: np.ndarray
    R_first: np.ndarray
    p_first: np.ndarray


@dataclass
class Landmark:
    """A point in the state: position in W (3,), also as first estimated; refused observations in a row."""

    X_W: np.ndarray
    X_first: np.ndarray
    strikes: int = 0


@dataclass
class State:
    """Owned by one `Msckf`; every change goes through it."""

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
    focal: float = 0.0
    clones: list[Clone] = field(default_factory=list)
    landmarks: dict[int, Landmark] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.freeze()

    def freeze(self) -> None:
        """Make the present inertial state the point at which the next propagation is linearised."""
        self.R_first, self.p_first, self.v_first = self.R_WB.copy(), self.p_WB.copy(), self.v_WB.copy()

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
        """Add an error estimate, shape (size,), to the state."""
        self.R_WB = self.R_WB @ so3.exp(dx[THETA])
        self.p_WB = self.p_WB + dx[POSITION]
        self.v_WB = self.v_WB + dx[VELOCITY]
        self.gyro_bias = self.gyro_bias + dx[GYRO_BIAS]
        self.accel_bias = self.accel_bias + dx[ACCEL_BIAS]
        self.R_BC = self.R_BC @ so3.exp(dx[CAMERA_ROTATION])
        self.p_BC = self.p_BC + dx[CAMERA_POSITION]
        self.time_offset += float(dx[TIME_OFFSET])
        self.focal += float(dx[FOCAL])
        n = len(self.clones)
        if n:
            steps = dx[CORE_SIZE : self.landmark_start].reshape(n, 6)
            R, p = self.window()
            for clone, R_WB, p_WB in zip(self.clones, R @ so3.exp(steps[:, :3]), p + steps[:, 3:]):
                clone.R_WB, clone.p_WB = R_WB, p_WB
        if self.landmarks:
            X = np.array([m.X_W for m in self.landmarks.values()]) + dx[self.landmark_start :].reshape(-1, 3)
            for landmark, X_W in zip(self.landmarks.values(), X):
                landmark.X_W = X_W

    def add_clone(self, frame: int, w_WB_B: np.ndarray) -> None:
        """Copy the present pose into the window.

        The pose belongs to stamp + time_offset: an error of the offset moves it along the motion, so that tracks tell
        the offset.

        Args:
            frame: number of the frame.
            w_WB_B: angular velocity in B [rad/s], shape (3,).
        """
        n, at = self.size, self.landmark_start
        J = np.zeros((CLONE_SIZE, n))
        J[:3, THETA] = J[3:, POSITION] = np.eye(3)
        J[:3, TIME_OFFSET], J[3:, TIME_OFFSET] = w_WB_B, self.v_WB
        JP = J @ self.P
        P, before, new, after = np.empty((n + 6, n + 6)), slice(0, at), slice(at, at + 6), slice(at + 6, n + 6)
        for rows, old in ((before, slice(0, at)), (after, slice(at, n))):
            P[rows, before], P[rows, after] = self.P[old, :at], self.P[old, at:]
            P[new, rows], P[rows, new] = JP[:, old], JP[:, old].T
        P[new, new] = JP @ J.T
        self.P = P
        self.clones.append(Clone(frame, self.R_WB.copy(), self.p_WB.copy(), self.R_WB.copy(), self.p_WB.copy()))

    def drop_clones(self, which: list[int]) -> None:
        """Marginalise clones: their rows leave the covariance."""
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

    def first_window(self) -> tuple[np.ndarray, np.ndarray]:
        """First estimates of the clones: R_WB (n, 3, 3), p_WB (n, 3)."""
        return np.array([c.R_first for c in self.clones]), np.array([c.p_first for c in self.clones])

    def null_space(self) -> np.ndarray:
        """Directions that no camera or IMU can see: position in W and yaw, shape (size, 4), at the first estimates."""
        e3, N = np.array([0.0, 0.0, 1.0]), np.zeros((self.size, 4))
        N[POSITION, :3] = np.eye(3)
        N[THETA, 3], N[POSITION, 3] = self.R_first.T @ e3, np.cross(e3, self.p_first)
        N[VELOCITY, 3] = np.cross(e3, self.v_first)
        for j, c in enumerate(self.clones):
            k = self.clone_at(j)
            N[k : k + 3, 3], N[k + 3 : k + 6, 3] = c.R_first.T @ e3, np.cross(e3, c.p_first)
            N[k + 3 : k + 6, :3] = np.eye(3)
        for i, m in enumerate(self.landmarks.values()):
            k = self.landmark_start + 3 * i
            N[k : k + 3, :3], N[k : k + 3, 3] = np.eye(3), np.cross(e3, m.X_first)
        return N
