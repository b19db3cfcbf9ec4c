"""A wire from its sightings: its shape, triangulation with degenerate baselines, and what its width in the image says."""

import numpy as np
import pytest
from oracles.wires import WIRE, observe
from perch_core import so3
from perch_core.catenary import Catenary
from perch_perception.line_mapping import Undetermined, LineObservation, TriangulationConfig, WireCurve, triangulate, triangulation
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

SETTINGS = TriangulationConfig()


def test_curve_follows_a_hanging_cable():
    """Against the catenary: 16 cm of sag over 8 m is kappa = 0.02, and the parabola stays within 2 mm of it."""
    cable = Catenary.from_sag(np.array([3.0, -4.0, 2.5]), np.array([3.0, 4.0, 2.5]), 0.16)
    curve = WireCurve(np.array([3.0, 0.0, 2.34]), np.array([0.0, 1.0, 0.0]), 0.02)
    points = cable.sample(50)
    np.testing.assert_allclose(curve.at(points[:, 1]), points, atol=2e-3)


def test_nearest_point_agrees_with_a_search():
    rng = np.random.default_rng(0)
    centres = rng.normal(0, 0.3, (20, 3)) + [0, 0, 2]
    rays = WIRE.at(rng.uniform(-2, 2, 20)) + rng.normal(0, 0.02, (20, 3)) - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for centre, ray, s in zip(centres, rays, WIRE.nearest(centres, rays)):
        best = minimize_scalar(lambda x: np.linalg.norm(np.cross(ray, WIRE.at(np.array(x)) - centre)),
                               bounds=(-4, 4), method="bounded", options={"xatol": 1e-9})
        assert s == pytest.approx(best.x, abs=2e-3)


def test_jacobian_of_the_offsets_against_finite_differences():
    rng = np.random.default_rng(1)
    centres = rng.normal(0, 0.3, (30, 3)) + [0, 0, 2]
    rays = WIRE.at(rng.uniform(-2, 2, 30)) + rng.normal(0, 0.005, (30, 3)) - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    jacobian = WIRE.offsets(centres, rays).jacobian
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-5
        numeric = (WIRE.moved(step).offsets(centres, rays).angles - WIRE.moved(-step).offsets(centres, rays).angles) / 2e-5
        np.testing.assert_allclose(jacobian[:, k], numeric, atol=0.02 * np.abs(numeric).max())


def test_exact_sightings_give_the_exact_wire(monkeypatch):
    monkeypatch.setattr(triangulation, "SAG", 1.0)
    rng = np.random.default_rng(2)
    seen = [observe(rng, WIRE, np.array([0.0, 0.1 * k, 2.0 + 0.1 * k])) for k in range(9)]
    wire = triangulate(seen, SETTINGS).curve
    s = np.linspace(-1.5, 1.5, 7)
    nearest = np.array([WIRE.at((p - WIRE.point) @ WIRE.direction) for p in wire.at(s)])
    np.testing.assert_allclose(wire.at(s), nearest, atol=2e-3)


@pytest.mark.parametrize("motion", [WIRE.direction, (WIRE.point - [0, 0, 2]) / np.linalg.norm(WIRE.point - [0, 0, 2])],
                         ids=["along the wire", "towards it"])
def test_degenerate_motion_is_refused(motion):
    rng = np.random.default_rng(3)
    line = WireCurve(WIRE.point, WIRE.direction)
    seen = [observe(rng, line, np.array([0.0, 0.0, 2.0]) + 0.1 * k * motion, noise=1e-3) for k in range(10)]
    with pytest.raises(Undetermined, match=r"baseline ratio 0.0[0-2]\d < 0.03: move across the wire"):
        triangulate(seen, SETTINGS)


def test_sightings_of_which_no_half_is_of_one_wire_are_refused():
    rng = np.random.default_rng(6)
    seen = [observe(rng, WIRE, np.array([0.0, 0.0, 1.6 + 0.1 * k]), noise=2e-4, radius=(0.02, 0.03, 0.045)[k % 3]) for k in range(9)]
    with pytest.raises(Undetermined, match="several wires"):
        triangulate(seen, SETTINGS)


def test_covariance_matches_the_errors_it_predicts():
    """NEES of the wire's middle, across it, with errors of rays, poses, odometry and mount as configured: inside the 99.9 % bounds."""
    rng = np.random.default_rng(4)
    values = []
    path = [np.array([0.0, 0.05 * k, 1.6 + 0.1 * k]) for k in range(10)]
    step = SETTINGS.pose_drift_moved * np.linalg.norm(path[1] - path[0]) ** 0.5
    for _ in range(120):
        seen, mount = [], so3.exp(SETTINGS.mount_rotation * rng.standard_normal(3))
        drift = np.cumsum(step * rng.standard_normal((10, 3)), axis=0)
        drift -= drift[-1]  # the wire is where the last sighting sees it
        for centre, drifted in zip(path, drift):
            true = observe(rng, WIRE, centre, noise=5e-4)
            turn = so3.exp(triangulation.POSE_ROTATION * rng.standard_normal(3)) @ mount
            seen.append(LineObservation(0.0, centre + drifted + triangulation.POSE_POSITION * rng.standard_normal(3),
                                        true.rays_W @ turn.T, true.ends_W @ turn.T, 5e-4, 0.005))
        wire = triangulate(seen, SETTINGS)
        point = wire.curve.at(np.array(0.0))
        error = WIRE.at((point - WIRE.point) @ WIRE.direction) - point
        axes = wire.curve.axes[:, :2]
        values.append((axes.T @ error) @ np.linalg.solve(axes.T @ wire.point_covariance(0.0) @ axes, axes.T @ error))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(values)) / len(values)
    assert 0.7 * low < np.mean(values) < high  # the fit's own robust weights make it a little cautious


def test_a_camera_that_is_mounted_askew_does_not_make_the_map_sure_of_itself():
    """Its error is the same in all sightings, and does not average out: errors in sigmas with and without knowing that."""
    wire, corners = WireCurve(np.array([5.0, 0.0, 4.75]), np.array([0.0, 1.0, 0.0])), np.array(
        [[0.0, 0.0, 4.2], [0.0, 0.0, 5.0], [1.6, 0.0, 5.0], [1.6, 0.0, 4.2], [0.0, 0.0, 4.2]])
    path = np.concatenate([np.linspace(a, b, 8, endpoint=False) for a, b in zip(corners, corners[1:])])
    nees, errors = {}, {}
    for sigma in (1e-6, 0.005):
        rng, found, off = np.random.default_rng(12), [], []
        for _ in range(25):
            askew, seen = so3.exp(0.005 * rng.standard_normal(3)), []
            for k, centre in enumerate(path):
                true = observe(rng, wire, centre, noise=2e-4)
                seen.append(LineObservation(0.3 * k, centre, true.rays_W @ askew.T, true.ends_W @ askew.T, 5e-4, 0.0))
            estimate = triangulate(seen, TriangulationConfig(mount_rotation=sigma))
            point, axes = estimate.curve.at(np.array(0.0)), estimate.curve.axes[:, :2]
            error = axes.T @ (wire.at((point - wire.point) @ wire.direction) - point)
            found.append(error @ np.linalg.solve(axes.T @ estimate.point_covariance(0.0) @ axes, error))
            off.append(error @ error)
        nees[sigma], errors[sigma] = float(np.mean(found)), float(np.sqrt(np.mean(off)))
    assert nees[0.005] < 3.0 < nees[1e-6], nees
    assert errors[0.005] < errors[1e-6], errors


def test_a_wrong_sighting_is_left_out():
    rng = np.random.default_rng(5)
    other = WireCurve(WIRE.point + [0.0, 0.0, 0.5], WIRE.direction, 0.02)
    seen = [observe(rng, other if k == 4 else WIRE, np.array([0.0, 0.0, 1.6 + 0.1 * k]), noise=2e-4) for k in range(9)]
    wire = triangulate(seen, SETTINGS)
    assert not wire.used[4] and wire.used.sum() == 8
    point = wire.curve.at(np.array(0.0))
    assert np.linalg.norm(WIRE.at((point - WIRE.point) @ WIRE.direction) - point) < 0.03


def test_a_wire_is_as_near_as_it_is_wide():
    """Flown up and down, then straight towards it, without parallax, by an odometry that drifts by 8 cm."""
    wire, error, rng = WireCurve(np.array([4.0, 0.0, 2.0]), np.array([0.0, 1.0, 0.0])), {}, np.random.default_rng(3)
    for radius in (0.0, 0.03):
        seen = []
        for k in range(60):
            height, forward = 1.0 + min(0.05 * k, max(3.0 - 0.05 * k, 1.0)), max(k - 40, 0) / 19.0
            true = np.array([2.85 * forward, 0.0, height])
            seen.append(observe(rng, wire, true, time=0.1 * k, radius=radius, believed=true + [0.08 * forward, 0.0, 0.0]))
        found = triangulate(seen, SETTINGS)
        error[radius] = abs(found.curve.point[0] - 4.08)
    assert error[0.0] > 0.06, "what the test is about"
    assert error[0.03] < 0.025 and found.radius == pytest.approx(0.03, rel=0.02), (error, found.radius)


def test_the_approach_tells_the_distance_without_knowing_the_radius():
    """A climb of 20 cm at 3 m, then a flight towards the wire: the climb gives the radius, and the radius the distance."""
    wire, errors = WireCurve(np.array([3.0, 0.0, 1.6]), np.array([0.0, 1.0, 0.0])), []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        seen = [observe(rng, wire, np.array([0.0, 0.0, 1.5 + 0.02 * k]), 5e-4, time=0.1 * k, radius=0.03) for k in range(11)]
        seen += [observe(rng, wire, np.array([0.2 * k, 0.0, 1.7]), 5e-4, time=1.0 + 0.1 * k, radius=0.03) for k in range(1, 10)]
        found = triangulate(seen, TriangulationConfig())
        errors.append(float(np.linalg.norm((found.curve.point - wire.point)[[0, 2]])))
    assert np.median(errors) < 0.01 and max(errors) < 0.04, errors

def test_a_wire_that_comes_back_after_a_gap_is_taken_where_it_is_seen():
    """The odometry has drifted by 7 cm while the wire was out of sight; one look from 0.7 m, then another, put it right."""
    wire, rng = WireCurve(np.array([5.0, 0.0, 3.8]), np.array([0.0, 1.0, 0.0])), np.random.default_rng(6)
    seen = [observe(rng, wire, np.array([2.7, 0.0, 3.6 + 0.03 * min(k, 50 - k)]), 3e-4, time=0.1 * k, radius=0.03) for k in range(0, 50, 2)]
    estimate = triangulate(seen, SETTINGS)
    for _ in range(3):
        estimate = triangulate(seen, SETTINGS, estimate)
    drift, errors = np.array([-0.03, 0.0, -0.065]), []
    for time, below in ((6.3, 0.75), (6.4, 0.5)):
        true = wire.point - [0.05, 0.0, below]
        seen.append(observe(rng, wire, true, 3e-4, time=time, radius=0.03, believed=true + drift))
        estimate = triangulate(seen, SETTINGS, estimate)
        assert estimate.used[-1]
        errors.append(float(np.linalg.norm((estimate.curve.point - wire.point - drift)[[0, 2]])))
    assert errors[0] < 0.04 and errors[1] < 0.02, errors


def test_the_width_of_two_wires_taken_for_one_is_left_out():
    rng = np.random.default_rng(4)
    seen = [observe(rng, WIRE, np.array([0.0, 0.1 * k, 1.5 + 0.1 * k]), 1e-4, radius=0.06 if k in (3, 7) else 0.03) for k in range(12)]
    wire = triangulate(seen, SETTINGS)
    assert wire.radius == pytest.approx(0.03, rel=0.02)
    point = wire.curve.at(np.array(0.0))
    assert np.linalg.norm(WIRE.at((point - WIRE.point) @ WIRE.direction) - point) < 0.02
