"""The target relative to the vehicle: where its covariance comes from, and fusion over many images."""

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.sensors import CalibrationSigmas
from perch_core.tag_board import load_board
from perch_core.vehicle import load_vehicle
from perch_perception.pose_buffer import BodyState
from perch_perception.sensor_file import calibration_sigmas
from perch_perception.tags import fuse, solve_board, start_fusion, to_map
from perch_perception.tags.fusion import RESTART_AFTER
from scipy.stats import chi2, poisson

BOARD = load_board("pad_four_tags")
MOUNT: CameraMount = load_vehicle("snapdragon").mounts["front"]
CALIBRATION = CalibrationSigmas()
P_WS, R_WS = np.array([3.0, 0.2, 1.2]), so3.exp(np.array([0.0, -np.pi / 3, 0.0]))
SIGMA = 0.06  # px


def body_covariance():
    sigma = np.array([0.01, 0.01, 0.01, 0.004, 0.004, 0.008])
    return np.diag(sigma**2)


class World:
    """One flight: errors of calibration and odometry drawn once, noise in every image."""

    def __init__(self, rng, focal=CALIBRATION.focal):
        self.rng = rng
        camera = MOUNT.camera
        true = dataclasses.replace(
            camera, fx=camera.fx * (1 + focal * rng.normal()), fy=camera.fy * (1 + focal * rng.normal()),
            cx=camera.cx + CALIBRATION.centre * rng.normal(), cy=camera.cy + CALIBRATION.centre * rng.normal())
        turn = so3.exp(CALIBRATION.rotation * rng.normal(size=3))
        aside = CALIBRATION.translation * rng.normal(size=3)
        self.true_mount = dataclasses.replace(MOUNT, camera=true, p_BC=MOUNT.p_BC + aside, R_BC=turn @ MOUNT.R_BC)
        self.late = CALIBRATION.time_offset * rng.normal()
        self.drift = rng.multivariate_normal(np.zeros(6), body_covariance())

    def image(self, p_WB, v_WB):
        """The measured target from one image taken at p_WB while flying at v_WB."""
        true_p = p_WB + self.late * v_WB
        R_WB = so3.exp(np.array([0.0, 0.05, 0.02]))
        p_WC, R_WC = self.true_mount.pose(true_p, R_WB)
        points_C = (BOARD.corners_S @ R_WS.T + P_WS - p_WC) @ R_WC
        pixels, _ = self.true_mount.camera.project(points_C)
        rays = MOUNT.camera.unproject(pixels + self.rng.normal(0, SIGMA, pixels.shape))
        board = solve_board(MOUNT.camera, BOARD.corners_S, rays, np.full((4, 4), SIGMA), BOARD.ids)
        turn = so3.exp(self.drift[3:])  # the odometry's frame is displaced: vehicle and target alike
        body = BodyState(0.0, turn @ p_WB + self.drift[:3], so3.quat_from_matrix(turn @ R_WB), turn @ v_WB, np.zeros(3), body_covariance())
        return to_map(board, body, MOUNT, CALIBRATION)


    @property
    def target(self):
        """The true target in the odometry's frame: position and attitude."""
        turn = so3.exp(self.drift[3:])
        return turn @ P_WS + self.drift[:3], turn @ R_WS


def nees(target, world):
    p, R = world.target
    e = np.concatenate([p - target.p_WS, so3.log(R @ target.R_WS.T)])
    return e @ np.linalg.solve(target.covariance, e), np.linalg.norm(e[:3])


def approach(world, images=20):
    for x in np.linspace(0.0, 1.3, images):
        yield world.image(np.array([x, 0.0, 1.1]), np.array([1.5, 0.0, 0.0]))


@pytest.mark.slow
@pytest.mark.parametrize("x", [0.0, 2.3])
def test_covariance_of_one_image_covers_calibration(x):
    """From afar, and at 0.7 m, where the camera's place on the body counts as much as what it sees."""
    rng = np.random.default_rng(0)
    values = [nees(world.image(np.array([x, 0.0, 1.1]), np.array([1.5, 0.0, 0.0])), world)[0] for world in (World(rng) for _ in range(200))]
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < np.mean(values) < high


@pytest.mark.slow
def test_fusion_stays_consistent_over_a_whole_approach():
    """NEES of the fused target over 40 flights: shared errors must not be averaged away, as an information filter without them does."""
    rng = np.random.default_rng(1)
    values, naive, fused_errors, single_errors, frames = [], [], [], [], 0
    for _ in range(40):
        target, world = None, World(rng)
        information, weighted, (p, R) = np.zeros((6, 6)), np.zeros(6), world.target
        for pose in approach(world):
            if target is None:
                single_errors.append(nees(pose, world)[1])
            target = start_fusion(pose) if target is None else fuse(target, pose)
            inverse = np.linalg.inv(pose.covariance)
            information += inverse
            weighted += inverse @ np.concatenate([p - pose.p_WS, so3.log(R @ pose.R_WS.T)])
        value, error = nees(target, world)
        values.append(value)
        naive.append(weighted @ np.linalg.solve(information, weighted))
        fused_errors.append(error)
        frames += target.frames
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < np.mean(values) < high
    assert np.mean(naive) > 3 * 6, "the errors that images share must matter here"
    images = 20 * len(values)
    assert images - frames <= poisson.ppf(0.999, 1e-3 * images), "the gate leaves out one image of a thousand"
    assert np.mean(fused_errors) < 0.8 * np.mean(single_errors), "fusion must help"


def test_a_contradicting_image_is_not_used_but_a_moved_pad_is_followed():
    world = World(np.random.default_rng(3))
    poses = list(approach(world))
    target = start_fusion(poses[0])
    for pose in poses[1:6]:
        target = fuse(target, pose)
    flipped = dataclasses.replace(poses[6], R_WS=poses[6].R_WS @ so3.exp(np.array([0.5, 0.0, 0.0])))
    after = fuse(target, flipped)
    assert (after.frames, after.refused) == (target.frames, 1)
    np.testing.assert_array_equal(after.p_WS, target.p_WS)
    assert fuse(after, poses[7]).refused == 0
    for pose in poses[7:7 + RESTART_AFTER]:
        after = fuse(after, dataclasses.replace(pose, p_WS=pose.p_WS + np.array([0.0, 1.0, 0.0])))
    assert after.p_WS[1] == pytest.approx(P_WS[1] + 1.0, abs=0.1)


def test_drift_between_two_images_makes_the_earlier_count_less():
    world = World(np.random.default_rng(4))
    first, second = list(approach(world, 2))
    target = start_fusion(first)
    still = fuse(target, second)
    drifted = fuse(target, dataclasses.replace(second, odometry=100.0 * second.odometry))
    assert np.trace(still.covariance[:3, :3]) < np.trace(drifted.covariance[:3, :3]) <= np.trace(second.covariance[:3, :3])
    np.testing.assert_allclose(drifted.p_WS, second.p_WS, atol=0.3 * np.linalg.norm(first.p_WS - second.p_WS))
    assert np.linalg.eigvalsh(drifted.joint)[0] > -1e-12


def test_odometry_that_has_drifted_for_an_hour_leaves_the_target_as_certain():
    """Its pose is off by metres, and vehicle and target are off alike."""
    board = solve_board(MOUNT.camera, BOARD.corners_S, MOUNT.camera.unproject(pixels_of(np.zeros(3))), np.full((4, 4), SIGMA), BOARD.ids)
    start, later = (to_map(board, BodyState(0.0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), sigma**2 * np.eye(6)),
                           MOUNT, CALIBRATION) for sigma in (1e-3, 3.0))
    np.testing.assert_array_equal(later.covariance, start.covariance)


def pixels_of(p_WB):
    p_WC, R_WC = MOUNT.pose(p_WB, np.eye(3))
    return MOUNT.camera.project((BOARD.corners_S @ R_WS.T + P_WS - p_WC) @ R_WC)[0]


def test_calibration_is_as_good_as_the_sensor_file_says():
    assert calibration_sigmas("snapdragon", "front", CalibrationSigmas(rotation=0.1)) == CALIBRATION
