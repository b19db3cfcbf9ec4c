"""Pose of the tag board from corners: accuracy, flips, honest covariance, outliers, edge profiles, virtual views."""

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import EquidistantCamera
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_core.vehicle import load_vehicle
from perch_perception.tags.average import average_board
from perch_perception.tags.edge_profile import STEPS, blur_of, fit_step, gradient_centroid
from perch_perception.tags.pose import LocalizationRefusal, solve_board
from perch_perception.tags.view import VirtualView
from scipy.spatial.transform import Rotation
from scipy.special import erf
from scipy.stats import chi2

BOARD = load_board("pad_four_tags")
MOUNT = load_vehicle("snapdragon").mounts["front"]
CAMERA = MOUNT.camera
CORNERS = BOARD.corners_S


def view_of_pad(rng, distance, inclination_deg, spread=0.08):
    """p_CS, R_CS of a pad in front of a nearly level camera."""
    surface = PerchSurface.from_inclination(
        np.array([distance, rng.normal(0, 0.1), rng.normal(0, 0.1)]), np.radians(inclination_deg))
    R_WC = so3.exp(rng.normal(0, spread, 3)) @ MOUNT.R_BC
    return R_WC.T @ surface.p_WS, R_WC.T @ surface.R_WS


def measure(rng, p_CS, R_CS, sigma, camera=CAMERA):
    """Rays of all corners with noise of `sigma` px, shape (4, 4, 3)."""
    pixels, valid = camera.project(CORNERS @ R_CS.T + p_CS)
    assert valid.all()
    return CAMERA.unproject(pixels + rng.normal(0, sigma, pixels.shape))


def errors(p_CS, R_CS, pose):
    return np.concatenate([p_CS - pose.p_CS, so3.log(R_CS @ pose.R_CS.T)])


def solve(rays, sigma, tags=(0, 1, 2, 3), **kwargs):
    tags = list(tags)
    return solve_board(CAMERA, CORNERS[tags], rays[tags], np.full((len(tags), 4), sigma), tuple(tags), **kwargs)


def test_exact_corners_give_the_exact_pose():
    rng = np.random.default_rng(0)
    for inclination in (0.0, 30.0, 60.0, 90.0, 120.0):
        p, R = view_of_pad(rng, 2.0, inclination) if inclination > 20 else (np.array([0.1, 0.7, 1.5]), None)
        if R is None:  # a pad on the ground in front of the vehicle
            R = MOUNT.R_BC.T @ PerchSurface.from_inclination(np.zeros(3), 0.0).R_WS
        pose = solve(measure(rng, p, R, 0.0), 0.05)
        np.testing.assert_allclose(errors(p, R, pose), 0.0, atol=1e-5)
        assert pose.rms < 1e-4


@pytest.mark.slow
def test_no_flip_survives_in_a_thousand_frames():
    rng = np.random.default_rng(1)
    turns = []
    for k in range(1000):
        p, R = view_of_pad(rng, rng.uniform(1.2, 3.2), (60.0, 90.0)[k % 2])
        turns.append(np.linalg.norm(errors(p, R, solve(measure(rng, p, R, 0.1), 0.1))[3:]))
    assert np.degrees(max(turns)) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("tags", [(0, 1, 2, 3), (0, 1), (2,)])
def test_covariance_matches_the_errors_it_predicts(tags):
    """Mean NEES over 150 trials inside its 99.9 % bounds, for the full board and for parts of it."""
    rng = np.random.default_rng(2)
    nees = []
    for _ in range(150):
        p, R = view_of_pad(rng, 1.5, 60.0)
        e = errors(p, R, solve(measure(rng, p, R, 0.08), 0.08, tags, prior_R_CS=R))
        nees.append(e @ np.linalg.solve(solve(measure(rng, p, R, 0.0), 0.08, tags, prior_R_CS=R).covariance, e))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(nees)) / len(nees)
    # one tag alone is strongly non-linear: its errors may exceed the linear prediction by a little
    assert low * 0.9 < np.mean(nees) < high * (1.0 if len(tags) == 4 else 1.15)


def test_one_ambiguous_tag_says_that_it_is_unsure():
    """A small tag seen almost face on has two poses: the covariance must cover the other one."""
    rng = np.random.default_rng(3)
    covered = wrong = 0
    for _ in range(60):
        p, R = view_of_pad(rng, 3.0, 78.0, spread=0.02)
        pose = solve(measure(rng, p, R, 0.25), 0.25, (1,))
        turn = errors(p, R, pose)[3:]
        if np.degrees(np.linalg.norm(turn)) > 15.0:
            wrong += 1
            along = turn / np.linalg.norm(turn)
            covered += np.linalg.norm(turn) < 3.0 * np.sqrt(along @ pose.covariance[3:, 3:] @ along)
    assert wrong >= 5, "the test must meet the ambiguity"
    assert covered >= 0.9 * wrong


def test_a_prediction_resolves_the_ambiguity():
    rng = np.random.default_rng(3)
    for _ in range(60):
        p, R = view_of_pad(rng, 3.0, 70.0, spread=0.02)
        pose = solve(measure(rng, p, R, 0.1), 0.1, (1,), prior_R_CS=R @ so3.exp(np.array([0.03, -0.03, 0.0])))
        assert np.degrees(np.linalg.norm(errors(p, R, pose)[3:])) < 15.0


def test_a_tag_that_is_elsewhere_is_left_out():
    rng = np.random.default_rng(4)
    p, R = view_of_pad(rng, 1.7, 60.0)
    rays = measure(rng, p, R, 0.05)
    moved = CORNERS[3] + np.array([0.05, 0.02, 0.0])
    rays[3] = CAMERA.unproject(CAMERA.project(moved @ R.T + p)[0])
    pose = solve(rays, 0.05)
    assert pose.dropped == (3,) and pose.ids == (0, 1, 2)
    assert np.linalg.norm(errors(p, R, pose)[:3]) < 0.01
    with pytest.raises(LocalizationRefusal, match="do not fit"):
        solve(rays, 0.05, (2, 3))  # which of the two is wrong cannot be known


def test_sensitivity_to_the_lens_agrees_with_another_lens():
    """d pose / d intrinsics against solving images of a lens that differs from the model."""
    rng = np.random.default_rng(5)
    p, R = view_of_pad(rng, 1.7, 60.0)
    exact = solve(measure(rng, p, R, 0.0), 0.05)
    step = {"fx": 1e-3 * CAMERA.fx, "fy": 1e-3 * CAMERA.fy, "cx": 0.2, "cy": 0.2}
    for column, (name, change) in enumerate(step.items()):
        true = dataclasses.replace(CAMERA, **{name: getattr(CAMERA, name) + change})
        pose = solve(measure(rng, p, R, 0.0, camera=true), 0.05)
        error = errors(p, R, pose)
        unit = 1e-3 if name in ("fx", "fy") else change
        np.testing.assert_allclose(error, exact.by_intrinsics[:, column] * unit,
                                   atol=0.05 * np.abs(error).max() + 1e-6)


@pytest.mark.slow
def test_a_lens_known_to_its_sigmas_makes_a_pose_as_sure_as_it_is():
    """And a better one than without considering the lens: an error of fx / fy does not go into the attitude."""
    rng = np.random.default_rng(6)
    sigma = np.array([0.003, 0.003, 0.5, 0.5])
    nees, considered, ignored = [], [], []
    for _ in range(200):
        p, R = view_of_pad(rng, 1.7, 75.0)
        k = rng.normal(0, sigma)
        true = dataclasses.replace(CAMERA, fx=CAMERA.fx * (1 + k[0]), fy=CAMERA.fy * (1 + k[1]), cx=CAMERA.cx + k[2], cy=CAMERA.cy + k[3])
        rays = measure(rng, p, R, 0.05, camera=true)
        pose = solve(rays, 0.05, lens_sigma=sigma)
        error = errors(p, R, pose)
        covariance = pose.covariance + pose.by_intrinsics @ np.diag(sigma**2) @ pose.by_intrinsics.T
        nees.append(error @ np.linalg.solve(covariance, error))
        considered.append(error[3:])
        ignored.append(errors(p, R, solve(rays, 0.05))[3:])
    low, high = chi2.ppf((0.025, 0.975), 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high
    assert np.linalg.norm(considered) < np.linalg.norm(ignored)


def printed(rng, sigma):
    """Corners of a board whose tags are each shifted in its plane."""
    return CORNERS + np.concatenate([rng.normal(0.0, sigma, (4, 1, 2)), np.zeros((4, 1, 1))], axis=2)


def test_a_board_glued_to_its_sigma_makes_a_pose_as_sure_as_it_is():
    rng, print_sigma, nees = np.random.default_rng(8), 2e-4, {0.0: [], 2e-4: []}
    for _ in range(60):
        p, R = view_of_pad(rng, 1.0, 90.0)
        pixels = CAMERA.project(printed(rng, print_sigma) @ R.T + p)[0]
        rays = CAMERA.unproject(pixels + rng.normal(0.0, 0.03, pixels.shape))
        for told, values in nees.items():
            pose = solve(rays, 0.03, start=(p, R), print_sigma=told)
            e = errors(p, R, pose)
            values.append(e @ np.linalg.solve(pose.covariance, e))
    assert 4.9 < np.mean(nees[print_sigma]) < 7.1  # 6 +- 0.45 (1 sigma)
    assert np.mean(nees[0.0]) > 8.0


@pytest.mark.slow
def test_the_papers_average_has_no_flips_but_the_joint_solution_is_better():
    """[M:sec. IV-B] at 3 m: single tags flip, their average with branches resolved does not."""
    rng = np.random.default_rng(6)
    average, joint, first_branch = [], [], []
    for _ in range(150):
        p, R = view_of_pad(rng, 3.0, 75.0)
        rays = measure(rng, p, R, 0.1)
        average.append(errors(p, R, average_board(CAMERA, CORNERS, rays, BOARD.ids)))
        joint.append(errors(p, R, solve(rays, 0.1)))
        first_branch.append(errors(p, R, solve(rays, 0.1, (0,))))
    turn = {name: np.degrees(np.linalg.norm(np.array(e)[:, 3:], axis=1))
            for name, e in (("average", average), ("joint", joint), ("single", first_branch))}
    assert np.percentile(turn["single"], 90) > 10.0, "single tags flip here"
    assert np.percentile(turn["average"], 90) < 6.0
    assert np.median(turn["joint"]) < 0.5 * np.median(turn["average"])
    assert np.median(np.abs(np.array(average)[:, :3])) < 0.02


def test_the_mean_of_rotations_is_the_one_of_scipy():
    rng = np.random.default_rng(5)
    for _ in range(100):
        R = Rotation.from_rotvec(rng.normal(0.0, 2.0, 3)) * Rotation.from_rotvec(rng.normal(0.0, 0.5, (4, 3)))
        np.testing.assert_allclose(so3.nearest(R.as_matrix().mean(axis=0)), R.mean().as_matrix(), atol=1e-12)


def test_average_needs_two_tags():
    rng = np.random.default_rng(7)
    p, R = view_of_pad(rng, 1.7, 60.0)
    with pytest.raises(LocalizationRefusal, match="at least 2"):
        average_board(CAMERA, CORNERS[:1], measure(rng, p, R, 0.0)[:1], (0,))


@pytest.mark.parametrize(("module", "blur"), [(1.6, 0.6), (1.8, 0.78), (3.0, 0.5), (3.0, 1.2), (6.0, 0.78), (6.0, 2.4)])
def test_step_fit_has_no_bias_from_the_neighbouring_edges(module, blur):
    """Profiles with a ring one module wide, of an unknown blur: the fit finds the step to 0.02 px, the centroid is off by 0.05."""
    s = np.linspace(-1.5 * module, 1.5 * module, STEPS)[None]
    edge = np.linspace(-0.4, 0.4, 9)

    def rise(x):
        return 0.5 * (1 + erf(x / (blur * np.sqrt(2))))

    def profiles(start):
        return np.array([20 + 210 * rise(s[0] + o - x) - 170 * rise(s[0] + o - x - module) for o, x in zip(start, edge)])

    module_, offset = np.array([module]), np.zeros(len(edge))
    for _ in range(2):  # the second round starts at the first's result, as the refinement does
        seen = profiles(offset)[None]
        offset = offset + fit_step(s, seen, module_, blur_of(s, seen.mean(axis=1), module_))[0][0]
    np.testing.assert_allclose(offset, edge, atol=0.02)
    if module < 2.0:
        assert np.abs(gradient_centroid(s, profiles(np.zeros(len(edge))))[0] - edge).max() > 0.05


def test_virtual_view_shows_what_its_rays_say():
    """A pattern that is a function of the ray alone, seen through the fisheye, is recovered in the view."""
    def shade(rays):
        return 127 + 100 * np.sin(6 * rays[..., 0]) * np.cos(5 * rays[..., 1])

    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    image = shade(np.nan_to_num(CAMERA.unproject(np.stack([u, v], -1)))).astype(np.uint8)
    view = VirtualView.aim(np.array([0.5, -0.3, 1.0]), np.radians(15), 700.0)
    grid = np.stack(np.meshgrid(np.arange(view.side), np.arange(view.side)), -1)
    seen = view.resample(image, CAMERA).astype(float)
    inner = slice(8, -8)
    assert np.abs(seen - shade(view.rays(grid)))[inner, inner].max() < 2.5
    middle = view.rays(np.array([view.centre, view.centre]))
    np.testing.assert_allclose(middle, np.array([0.5, -0.3, 1.0]) / np.linalg.norm([0.5, -0.3, 1.0]), atol=1e-12)


def test_virtual_view_along_the_image_axis_is_defined():
    view = VirtualView.aim(np.array([0.0, 1.0, 0.0]), 0.3, 300.0)
    np.testing.assert_allclose(view.R_CV.T @ view.R_CV, np.eye(3), atol=1e-12)
    assert isinstance(CAMERA, EquidistantCamera) and view.side <= 640
