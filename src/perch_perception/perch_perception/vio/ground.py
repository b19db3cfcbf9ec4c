"""Ground points as the first landmarks, which give a take-off its scale.

The height of a standing vehicle's camera above the ground is known. Without this, the scale of the map results from the first
centimetres of the climb, flown on the IMU alone: from 13 cm above the floor, a drift of 1 cm made the heights of whole flights
wrong by 14 %. Where the camera stands so low that its image of the ground is blurred, no landmarks are added.
"""

from __future__ import annotations

import numpy as np

from perch_perception.vio import state as at
from perch_perception.vio.bearing import POINT, Bearings, residuals
from perch_perception.vio.landmark_choice import Spread
from perch_perception.vio.msckf import Msckf

SIGMA = 0.005         # of the ground about its plane: a level floor [m]
_MIN_HEIGHT = 0.08    # a camera that stands lower sees a blur [m]
_MIN_SINE = 0.35      # least sine of a ray below the horizon
_CALIBRATION = np.arange(at.INERTIAL_SIZE, at.CORE_SIZE)
_POSE = np.r_[0:6]    # theta, p


def add_ground_landmarks(filter: Msckf, ids: np.ndarray, bearings: Bearings, floor: float) -> int:
    """Add ground points as landmarks to the state of a vehicle that stands on the ground.

    A point lies where its ray intersects the plane z = floor. Two rows of its bearing's residual and one of the plane determine
    it: [H_X; e3^T] dX = -[H_x; 0] dx + (n_b, n_f), which gives its covariance with the pose and the calibration.

    Args:
        filter: its state is that of the standing vehicle.
        ids: numbers of the features, shape (n,).
        bearings: their bearings while the vehicle stood.
        floor: height of the ground in W [m].

    Returns:
        Number of landmarks added.
    """
    s, limits = filter.state, filter.config.filter
    centre = s.p_WB + s.R_WB @ s.p_BC
    height = float(centre[2] - floor)
    if height < _MIN_HEIGHT or not len(ids):
        return 0
    rays = bearings.b_C @ (s.R_WB @ s.R_BC).T
    spread, chosen = Spread({}, limits.landmarks), list[int]()
    for k in np.flatnonzero(rays[:, 2] < -_MIN_SINE).tolist():
        if len(chosen) < limits.landmarks and spread.admits(bearings.b_C[k]):
            spread.add(int(ids[k]), bearings.b_C[k])
            chosen.append(k)
    if not chosen:
        return 0
    X = centre - height / rays[chosen, 2:3] * rays[chosen]
    n = len(chosen)
    seen = Bearings(bearings.b_C[chosen], bearings.shape[chosen])
    linear = residuals(np.broadcast_to(s.R_WB, (n, 3, 3)), np.broadcast_to(s.p_WB, (n, 3)), X, s.R_BC, s.p_BC, seen)
    columns = np.r_[_CALIBRATION, _POSE]
    noise = np.ones(n) if bearings.noise is None else bearings.noise[chosen]
    for k, i in enumerate(chosen):
        inverse = np.linalg.inv(np.vstack([linear.J[k, :, POINT], [0.0, 0.0, 1.0]]))
        variance = np.diag([(noise[k] * filter.sigma) ** 2, (noise[k] * filter.sigma) ** 2, SIGMA**2])
        J = -inverse[:, :2] @ linear.J[k, :, : POINT.start]
        cross = J @ s.P[columns]
        own = J @ s.P[np.ix_(columns, columns)] @ J.T + inverse @ variance @ inverse.T
        s.add_landmark(int(ids[i]), X[k], np.zeros(3), cross, own)
    return n
