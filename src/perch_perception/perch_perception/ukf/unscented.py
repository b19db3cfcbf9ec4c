"""The unscented transforms of the UKF: prediction through IMU steps and the update with a VIO pose.

Sigma points and weights are filterpy's (`MerweScaledSigmaPoints`) on the error vector; the points live on the
manifold through `layout.plus`/`minus`. Prediction runs in `kernels.unscented_run`; without numba, in the vectorised
form here. The equations are in docs/estimation.md, section UKF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints

from perch_core import so3
from perch_core.errors import PerchError
from perch_core.jit import COMPILED
from perch_core.vehicle import GRAVITY
from perch_perception.ukf import kernels
from perch_perception.ukf import layout as at
from perch_perception.ukf.config import UkfConfig

# columns of a run of IMU steps
DT, GYRO, ACCEL, GYRO_VARIANCE, ACCEL_VARIANCE = 0, slice(1, 4), slice(4, 7), 7, 8


class CovarianceError(PerchError):
    """A covariance lost its positive definiteness: the filter has to be started again."""


@dataclass(frozen=True)
class Belief:
    """Nominal state and error covariance at a time.

    Attributes:
        stamp: time [ns].
        x: nominal state, shape (22,), see `layout`.
        P: error covariance, shape (21, 21).
    """

    stamp: int
    x: np.ndarray
    P: np.ndarray


@dataclass(frozen=True)
class Innovation:
    """What a measurement said against the prediction.

    Attributes:
        residual: measured minus predicted, shape (6,).
        S: its covariance, shape (6, 6).
        gain: Kalman gain, shape (21, 6).
        nis: residual^T S^-1 residual.
    """

    residual: np.ndarray
    S: np.ndarray
    gain: np.ndarray
    nis: float


class UnscentedTransform:
    """Prediction and update for one configuration; holds only constants."""

    def __init__(self, config: UkfConfig) -> None:
        self.config = config
        self.points = MerweScaledSigmaPoints(at.ERROR_SIZE, config.alpha, config.beta, config.kappa)
        self.scale = 0.5 / self.points.Wm[1]

    def predict(self, belief: Belief, run: np.ndarray, stamp: int) -> Belief:
        """Belief after a run of IMU steps that ends at `stamp`.

        Args:
            belief: at the start of the run.
            run: rows (dt, gyro, accel, gyro variance, accel variance), shape (m, 9).
            stamp: end of the run [ns].

        Raises:
            CovarianceError: the covariance is not positive definite.
        """
        if len(run) == 0:
            return Belief(stamp, belief.x, belief.P)
        if COMPILED:
            x, P = np.empty(at.NOMINAL_SIZE), np.empty((at.ERROR_SIZE, at.ERROR_SIZE))
            Wm, Wc = self.points.Wm, self.points.Wc
            if not kernels.unscented_run(belief.x, belief.P, run, self.scale, Wm[0], Wc[0], Wm[1], x, P):
                raise CovarianceError(f"covariance at {belief.stamp} ns is not positive definite")
        else:
            x, P = self.predict_vectorised(belief.x, belief.P, run)
        P += self.process_noise(run)
        return Belief(stamp, x, P)

    def predict_vectorised(self, x: np.ndarray, P: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same transform in numpy, all sigma points at once: the form without numba, and the kernel's check."""
        points = at.plus(x, self._sigma_points(P))
        gravity = np.array([0.0, 0.0, GRAVITY])
        p, v, q = points[:, at.POSITION], points[:, at.VELOCITY], points[:, at.QUATERNION]
        for row in run:
            dt = row[DT]
            half = so3.quat_exp((row[GYRO] - points[:, at.GYRO_BIAS]) * (0.5 * dt))
            middle = so3.quat_multiply(q, half)
            a_W = so3.quat_rotate(middle, row[ACCEL] - points[:, at.ACCEL_BIAS]) - gravity
            p = p + (v + 0.5 * dt * a_W) * dt
            v = v + a_W * dt
            q = so3.quat_multiply(middle, half)
        points[:, at.POSITION], points[:, at.VELOCITY], points[:, at.QUATERNION] = p, v, q
        deviations = at.minus(points, points[0])
        mean = self.points.Wm @ deviations
        centred = deviations - mean
        return at.plus(points[0], mean), (centred * self.points.Wc[:, None]).T @ centred

    def process_noise(self, run: np.ndarray) -> np.ndarray:
        """Covariance that a run's IMU noise and bias walks add, shape (21, 21).

        White noise of each sample: attitude sum(s_g^2 dt^2), velocity sum(s_a^2 dt^2) =: q, which the double
        integral carries into the position as q T^2/3 and q T/2. Couplings of higher order in T (40 ms) are left out.
        """
        dt = run[:, DT]
        T = float(dt.sum())
        q = float(run[:, ACCEL_VARIANCE] @ (dt * dt))
        Q = np.zeros((at.ERROR_SIZE, at.ERROR_SIZE))
        d = np.arange(3)
        Q[d, d] = q * T * T / 3
        Q[d, 3 + d] = Q[3 + d, d] = q * T / 2
        Q[3 + d, 3 + d] = q
        Q[6 + d, 6 + d] = float(run[:, GYRO_VARIANCE] @ (dt * dt))
        Q[9 + d, 9 + d] = self.config.imu.gyro_bias_walk**2 * T
        Q[12 + d, 12 + d] = self.config.imu.accel_bias_walk**2 * T
        return Q

    def innovate(self, belief: Belief, p_WB: np.ndarray, q_WB: np.ndarray, R: np.ndarray) -> Innovation:
        """Innovation and gain for a VIO pose at the belief's time.

        The prediction of a sigma point is p + drift_p and exp(drift_theta) R_WB: VIO's own map is off by the
        drift. Attitude residuals are rotation vectors in W about the predicted attitude of the centre.

        Args:
            belief: predicted to the pose's stamp.
            p_WB, q_WB: VIO's pose, shapes (3,), (4,).
            R: white measurement noise, shape (6, 6).

        Raises:
            CovarianceError: the covariance is not positive definite.
        """
        E = self._sigma_points(belief.P)
        X = at.plus(belief.x, E)
        q_pred = so3.quat_multiply(so3.quat_exp(X[:, 19:22]), X[:, at.QUATERNION])
        back = so3.quat_conjugate(q_pred[0])
        Z = np.concatenate([X[:, at.POSITION] + X[:, 16:19], so3.quat_log(so3.quat_multiply(q_pred, back))], axis=1)
        z = np.concatenate([p_WB, so3.quat_log(so3.quat_multiply(q_WB, back))])
        mean = self.points.Wm @ Z
        weighted = (Z - mean) * self.points.Wc[:, None]
        S = weighted.T @ (Z - mean) + R
        gain = np.linalg.solve(S, weighted.T @ E).T
        residual = z - mean
        return Innovation(residual, S, gain, float(residual @ np.linalg.solve(S, residual)))

    def correct(self, belief: Belief, innovation: Innovation) -> Belief:
        """Belief after a measurement.

        After the injection the attitude error is counted from the new nominal attitude: its covariance turns by
        the right Jacobian of the correction.
        """
        step = innovation.gain @ innovation.residual
        P = belief.P - innovation.gain @ innovation.S @ innovation.gain.T
        G = np.eye(at.ERROR_SIZE)
        G[at.D_ATTITUDE, at.D_ATTITUDE] = so3.right_jacobian(step[at.D_ATTITUDE])
        P = G @ P @ G.T
        return Belief(belief.stamp, at.plus(belief.x, step), 0.5 * (P + P.T))

    def _sigma_points(self, P: np.ndarray) -> np.ndarray:
        try:
            return self.points.sigma_points(np.zeros(at.ERROR_SIZE), P)
        except np.linalg.LinAlgError:
            raise CovarianceError("covariance is not positive definite") from None
