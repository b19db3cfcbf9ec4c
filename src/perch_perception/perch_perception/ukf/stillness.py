"""Detection of rest from the IMU: the stance hypothesis of Skog et al. (Zero-velocity detection - an algorithm evaluation, 2010).

In flight, rotors and control corrections shake a vehicle; at rest, its IMU is as quiet as the sensor's noise. Under the
hypothesis that the vehicle rests, gyro and accelerometer read constants with the noise of the sensor,

    T = 1/(N - 1) sum ( |f_k - f_mean|^2 / sigma_a^2 + |w_k - w_mean|^2 / sigma_w^2 ),    E[T] = 6,

and these constants are the gyro's bias and, with the accelerometer's bias, g in any direction. The tolerance of the means follows
from the uncertainty of the biases and from the scatter of the readings. Where no filter has estimated the biases, the largest
turn-on biases are assumed.

The test works in any attitude and requires no images. It cannot distinguish constant motion from rest, nor a hover whose vibration is
within the sensor file's noise. After a motion the caller therefore requires that the velocity may be zero (`ukf.rest`, `vio.rest`),
and evidence beyond a quiet IMU: a static image, or rotors that stand (docs/estimation.md).
"""

from __future__ import annotations

import numpy as np

from perch_core.values import RotorState
from perch_core.vehicle import GRAVITY
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.ukf.unscented import ACCEL, ACCEL_VARIANCE, DT, GYRO, GYRO_VARIANCE

WINDOW = 0.2           # IMU over which rest is judged [s]
REST_VELOCITY = 0.002  # 1 sigma of the velocity at rest [m/s]
MAX_GYRO_BIAS, MAX_ACCEL_BIAS = 0.35, 1.5  # largest turn-on biases of MEMS sensors: 20 deg/s, 150 mg [rad/s, m/s^2]
_MAX_ENERGY = 1.8     # of T / 6: 1 is rest
_MIN_SAMPLES = 10
_MIN_COVERAGE = 0.9   # share of the window that the samples must span
_LAST_PART = 4        # part of the window, its last, that must look like rest as well: a departure has just begun
_MEAN_GATE = 6.0      # sigma up to which a mean counts as zero
_STANDING = 10.0      # speed below which a rotor stands: armed ones idle at 100 rad/s and more [rad/s]
_ROTORS_VALID = 500_000_000  # age up to which a state of the rotors counts [ns]


def energy(steps: np.ndarray) -> float:
    """Return T / 6 of IMU steps (m, 9), m > 1: the ratio of their scatter to that of the sensor's noise."""
    f, w = steps[:, ACCEL], steps[:, GYRO]
    T = (((f - f.mean(axis=0)) ** 2).sum(axis=1) / steps[:, ACCEL_VARIANCE]).sum()
    T += (((w - w.mean(axis=0)) ** 2).sum(axis=1) / steps[:, GYRO_VARIANCE]).sum()
    return float(T) / (6 * (len(steps) - 1))


def is_at_rest(steps: np.ndarray, biases: np.ndarray | None = None, variance: np.ndarray | None = None,
               image_is_static: bool = False) -> bool:
    """Whether IMU steps are those of a vehicle at rest.

    Args:
        steps: as from `ImuBuffer.run`, shape (m, 9).
        biases: of gyro and accelerometer [rad/s, m/s^2], shape (6,); None: unknown.
        variance: of the biases, shape (6,); None: the largest turn-on biases are assumed.
        image_is_static: the camera images show no motion: vibration, e.g. of the rotors, then does not exclude rest.
    """
    if len(steps) < _MIN_SAMPLES or steps[:, DT].sum() < _MIN_COVERAGE * WINDOW:
        return False
    known = np.array([MAX_GYRO_BIAS, MAX_ACCEL_BIAS]) if variance is None else 3.0 * np.sqrt(variance.reshape(2, 3).max(axis=1))
    sigma = np.sqrt(np.median(steps[:, [GYRO_VARIANCE, ACCEL_VARIANCE]], axis=0))  # of a whole sample: the first and last are cut
    off = _excess_means(steps, biases, known)
    if not image_is_static and energy(steps) + float(((off / sigma) ** 2).sum()) / 6.0 > _MAX_ENERGY:
        return False
    spread = np.maximum(sigma, steps[:, 1:7].std(axis=0).reshape(2, 3).max(axis=1))
    latest = steps[-max(len(steps) // _LAST_PART, 2):]
    if (image_is_static or biases is None) and (off > _MEAN_GATE * spread / np.sqrt(len(steps))).any():
        return False
    return bool((_excess_means(latest, biases, known) < _MEAN_GATE * spread / np.sqrt(len(latest))).all())


def rotors_stand(rotors: RotorState | None, now: int) -> bool | None:
    """Whether the rotors stand by their newest state, at a stamp `now` [ns]; None: there is no state, or an old one."""
    if rotors is None or abs(now - rotors.stamp) > _ROTORS_VALID:
        return None
    return max(map(abs, rotors.speed)) < _STANDING


def _excess_means(steps: np.ndarray, biases: np.ndarray | None, known: np.ndarray) -> np.ndarray:
    """Return by how much the mean gyro and accelerometer readings deviate from rest beyond the bias bounds `known`, each (2,)."""
    mean = steps[:, 1:7].mean(axis=0) - (0.0 if biases is None else biases)
    return np.maximum(np.abs([np.linalg.norm(mean[:3]), np.linalg.norm(mean[3:]) - GRAVITY]) - known, 0.0)


def window(imu: ImuBuffer, end: int) -> np.ndarray:
    """Return the steps over which rest at a stamp `end` [ns] is tested, shape (m, 9)."""
    return imu.run(max(imu.oldest, end - round(WINDOW * 1e9)), end, sensor_noise=True)
