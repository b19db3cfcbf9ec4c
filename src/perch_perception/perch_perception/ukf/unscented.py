"""The unscented transforms of the UKF: prediction through IMU steps and the update with a pose.

Sigma points and weights are the scaled ones of van der Merwe on the error vector. The prediction is in `kernels`, the update
in `update_kernels`. The equations are in docs/estimation.md, section UKF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core.errors import PerchError
from perch_core.probability import chi2_quantile
from perch_perception.ukf import kernels, update_kernels
from perch_perception.ukf import layout as at
from perch_perception.ukf.config import UkfConfig
from perch_perception.ukf.measurement import VioPose

# van der Merwe's spread of the sigma points: with alpha = 1 no weight is negative; beta = 2 is that of a Gaussian
ALPHA, BETA, KAPPA = 1.0, 2.0, 0.0
# NIS that 99.9 % of the right measurements stay below, by their size
GATES = {m: float(chi2_quantile(0.999, m)) for m in (3, 6, 9)}
# columns of a run of IMU steps
DT, GYRO, ACCEL, GYRO_VARIANCE, ACCEL_VARIANCE = 0, slice(1, 4), slice(4, 7), 7, 8


class CovarianceError(PerchError):
    """Raised when a covariance is not positive definite: the filter must restart."""


@dataclass(frozen=True)
class Belief:
    """Nominal state and error covariance at a time.

    Attributes:
        stamp: time [ns].
        x: nominal state, shape (16,), see `layout`.
        P: error covariance, shape (15, 15).
    """

    stamp: int
    x: np.ndarray
    P: np.ndarray


@dataclass(frozen=True)
class Innovation:
    """Innovation of a measurement: residual, covariance and gain.

    Attributes:
        residual: measured minus predicted, shape (m,).
        S: its covariance, shape (m, m).
        gain: Kalman gain, shape (15, m).
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
        n = at.ERROR_SIZE
        spread = ALPHA**2 * (n + KAPPA) - n
        self.Wm = np.full(2 * n + 1, 0.5 / (n + spread))  # weights for the mean, and for the covariance
        self.Wc = self.Wm.copy()
        self.Wm[0] = spread / (n + spread)
        self.Wc[0] = self.Wm[0] + (1.0 - ALPHA**2 + BETA)
        self.scale = 0.5 / self.Wm[1]

    def predict(self, belief: Belief, run: np.ndarray, stamp: int) -> Belief:
        """Return the belief after a run of IMU steps that ends at `stamp`.

        Args:
            belief: at the start of the run.
            run: rows (dt, gyro, accel, gyro variance, accel variance), shape (m, 9).
            stamp: end of the run [ns].

        Raises:
            CovarianceError: the covariance is not positive definite.
        """
        if len(run) == 0:
            return Belief(stamp, belief.x, belief.P)
        x, P = np.empty(at.NOMINAL_SIZE), np.empty((at.ERROR_SIZE, at.ERROR_SIZE))
        imu, Wm, Wc = self.config.imu, self.Wm, self.Wc
        if not kernels.unscented_run(belief.x, belief.P, run, self.scale, Wm[0], Wc[0], Wm[1], x, P):
            raise CovarianceError(f"covariance at {belief.stamp} ns is not positive definite")
        update_kernels.add_process_noise(run, imu.gyro_bias_walk**2, imu.accel_bias_walk**2, P)
        return Belief(stamp, x, P)

    def innovate(self, belief: Belief, pose: VioPose, R: np.ndarray) -> Innovation:
        """Return innovation and gain for a pose and, where measured, a velocity at the belief's time.

        The prediction of a sigma point is p_WB, R_WB and, where the velocity is measured, R_WB^T v_WB. Attitude residuals are
        rotation vectors in W about the attitude of the centre.

        Args:
            belief: predicted to the pose's stamp.
            pose: the measurement.
            R: noise of (position, rotation about W's axes), shape (6, 6), or of these and the velocity in B, shape (9, 9).

        Raises:
            CovarianceError: the covariance is not positive definite.
        """
        m = len(R)
        z = np.concatenate([pose.p_WB, pose.q_WB, pose.v_B if m == 9 else ()])
        residual, S, gain = np.empty(m), np.empty((m, m)), np.empty((at.ERROR_SIZE, m))
        Wm, Wc = self.Wm, self.Wc
        nis = update_kernels.innovate(belief.x, belief.P, z, R, self.scale, Wm[0], Wc[0], Wm[1], residual, S, gain)
        if nis < 0.0:
            raise CovarianceError("covariance is not positive definite")
        return Innovation(residual, S, gain, nis)

    @staticmethod
    def correct(belief: Belief, innovation: Innovation) -> Belief:
        """Return the belief after a measurement.

        After the injection, the attitude error refers to the new nominal attitude: its covariance is transformed by the right
        Jacobian of the correction.
        """
        x, P = np.empty(at.NOMINAL_SIZE), np.empty((at.ERROR_SIZE, at.ERROR_SIZE))
        update_kernels.correct(belief.x, belief.P, innovation.gain, innovation.S, innovation.residual, x, P)
        return Belief(belief.stamp, x, P)
