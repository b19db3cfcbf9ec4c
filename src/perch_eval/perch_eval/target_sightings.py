"""Localisation of the pad along a flight of `estimation_flight`: errors and covariances of its pose relative to the vehicle.

The images have the camera's calibration errors and the body's pose is the estimator's. The error thus has all parts that the
covariance of `target/pose` describes: it is the error of T_BS, in the axes of W.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from perch_core import so3
from perch_core.sensors import CalibrationSigmas
from perch_core.tag_board import load_board
from perch_core.vehicle import load_vehicle
from perch_eval.estimation_flight import EstimatorTrack, Flight
from perch_perception.pose_buffer import BodyState
from perch_perception.tags import BoardLocalizer, to_map
from perch_sim.calibration import true_mount
from perch_sim.rendering import Renderer, build_scene
from perch_sim.scenario import Scenario


@dataclass(frozen=True)
class Sightings:
    """Poses of the pad from n images.

    Attributes:
        times: middle of the exposure [s], shape (n,).
        errors: truth minus estimate of (position, rotation) relative to the vehicle, in the axes of W, shape (n, 6); NaN where the pad was
            not found.
        covariances: shape (n, 6, 6); NaN likewise.
    """

    times: np.ndarray
    errors: np.ndarray
    covariances: np.ndarray


def estimated_body(flight: Flight, track: EstimatorTrack, time: float) -> BodyState:
    """Return the estimated state at a time [s], from the truth and the track's error; its covariance is in the axes of W."""
    truth = flight.motion.sample(np.array([time]))
    k = int(np.argmin(np.abs(track.times - time)))
    e = np.array([np.interp(time, track.times, column) for column in track.errors.T])
    R_WB = truth.R_WB[0] @ so3.exp(-e[6:9])
    J = np.zeros((6, 15))
    J[:3, :3], J[3:, 6:9] = np.eye(3), R_WB
    return BodyState(time, truth.p_WB[0] - e[:3], so3.quat_from_matrix(R_WB), truth.v_WB[0] - e[3:6],
                     truth.w_WB_B[0] + e[9:12], J @ track.covariances[k] @ J.T)


def see_target(scenario: Scenario, flight: Flight, track: EstimatorTrack, seed: int, begin: float, end: float) -> Sightings:
    """Localise the pad in images at the camera's rate.

    Args:
        scenario: room, pad and realism.
        flight: sensor data, made with the same seed.
        track: of the estimator along the flight.
        seed: of the camera's calibration errors and noise.
        begin, end: time span of the images [s].
    """
    mount, board = load_vehicle(scenario.vehicle).mounts["front"], load_board(scenario.target.board)
    rng = np.random.default_rng([seed, 8])
    real = mount if scenario.realism == "ideal" else true_mount(mount, rng)
    renderer, localizer, surface = Renderer(build_scene(scenario, seed), real, seed), BoardLocalizer(board, mount), scenario.surface
    times = np.arange(begin, end, 1 / mount.rate)
    errors, covariances = np.full((len(times), 6), np.nan), np.full((len(times), 6, 6), np.nan)
    for k, middle in enumerate(times):
        poses = flight.motion.sample(middle + np.linspace(-0.5, 0.5, 5) * renderer.exposure.time)
        image = renderer.render(list(zip(poses.p_WB, poses.R_WB)), rng)
        exposed = float(middle + real.stamp_offset - mount.stamp_offset)  # as the stamp says it
        body = estimated_body(flight, track, exposed)
        found = localizer.process(image, exposed, body).board
        if found is not None:
            pose = to_map(found, body, mount, CalibrationSigmas())
            true = flight.motion.sample(np.array([exposed]))
            turn = body.R_WB @ true.R_WB[0].T  # where the true vehicle is put where the estimated one is, the true pad is there
            p_WS, R_WS = body.p_WB + turn @ (surface.p_WS - true.p_WB[0]), turn @ surface.R_WS
            errors[k] = np.concatenate([p_WS - pose.p_WS, so3.log(R_WS @ pose.R_WS.T)])
            covariances[k] = pose.covariance
    return Sightings(times, errors, covariances)
