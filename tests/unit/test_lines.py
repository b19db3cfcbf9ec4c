"""Line geometry, costs and constraints against brute force, a pinhole camera and CasADi. [tests P:eq3-13]"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from perch_core import lines, so3
from perch_core.components import components, stack
from perch_core.errors import PerchError
from perch_core.lines import Segment

RADII = (0.27, 0.2, 0.09)


def random_pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(-1, 1, 3), so3.quat_exp(rng.normal(0, 1.5, 3))


def random_segment(rng: np.random.Generator) -> Segment:
    return Segment(rng.uniform(-1, 1, 3), rng.normal(size=3), rng.uniform(0.3, 2), 0.03)


def brute_clearance(p: np.ndarray, q: np.ndarray, segment: Segment, reach: float) -> float:
    """Least ellipsoid coordinate of points along the segment: 1 on the surface of the inflated ellipsoid."""
    s = np.linspace(-reach, reach, 200_001)
    points = segment.centre + s[:, None] * segment.direction
    local = (points - p) @ so3.quat_to_matrix(q)
    return float(np.linalg.norm(local / (np.array(RADII) + segment.radius), axis=1).min())


@pytest.mark.parametrize("seed", range(20))
def test_scaled_clearance_is_the_brute_force_distance_to_the_finite_segment(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (p, q), segment = random_pose(rng), random_segment(rng)
    value = lines.scaled_clearance(p[None], q[None], segment, RADII)[0]
    assert value + 1 == pytest.approx(brute_clearance(p, q, segment, segment.half_length), abs=1e-4)


@pytest.mark.parametrize("seed", range(20))
def test_line_distance_is_the_brute_force_distance_to_the_infinite_line(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    (p, q), segment = random_pose(rng), random_segment(rng)
    radii = tuple(r + segment.radius for r in RADII)
    o, l = lines.scaled_line(components(p), components(q), components(segment.centre), components(segment.direction), radii)
    brute = brute_clearance(p, q, segment, 20.0)
    # [P:eq5] is [P:eq4] times |l|^2: the same sign, and zero on the surface.
    assert lines.line_clearance(o, l) == pytest.approx((brute**2 - 1) * np.dot(l, l), rel=1e-4, abs=1e-6)


def test_segment_constraint_acts_beside_the_segment_and_not_beyond_its_ends() -> None:
    segment = Segment([0, 0, 2], [0, 1, 0], 1.0, 0.03)
    level = np.array([0.0, 0, 0, 1])

    def clearance(p: list[float]) -> float:
        return float(lines.segment_clearance(tuple(p), tuple(level), components(segment.centre),
                                             components(segment.direction), 1.0, 0.03, RADII))

    assert clearance([0, 0, 2]) < 0  # through the middle
    assert clearance([0, 0.9, 2.1]) < 0  # touching near the end
    assert clearance([0, 1.5, 2]) > 0  # on the infinite line, past the end
    assert clearance([0, 0, 2.13]) > 0 > clearance([0, 0, 2.11])  # 0.09 + 0.03 above


@pytest.mark.parametrize("angle_deg", [0, 45, 90])
def test_a_segment_far_away_is_no_obstacle_however_the_body_is_turned(angle_deg: int) -> None:
    """On the continuation of a wire too, where it is the body's thinnest axis: above a mast."""
    direction = np.array([0.0, np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    segment = Segment(-3 * direction, direction, 1.0, 0.03)
    o, l = lines.scaled_line((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), components(segment.centre), components(direction), tuple(r + 0.03 for r in RADII))
    h = lines.segment_clearance((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), components(segment.centre), components(direction), 1.0, 0.03, RADII)
    assert h >= 2 * np.dot(l, l) * (1 - 1e-9)


def test_activation_is_negligible_where_the_body_can_touch() -> None:
    inside = lines.segment_activation((0.0, 0.0, 1.0 + 0.3), (0.0, 0.0, 0.0), 1.0, 0.3)
    outside = lines.segment_activation((0.0, 0.0, 1.0 + 0.3 + 0.05), (0.0, 0.0, 0.0), 1.0, 0.3)
    assert inside < 1e-3 and outside > 0.99


@pytest.mark.parametrize("seed", range(20))
def test_camera_metrics_agree_with_projected_points(seed: int) -> None:
    rng = np.random.default_rng(200 + seed)
    (p, q), (p_BC, q_BC) = random_pose(rng), random_pose(rng)
    segment = random_segment(rng)
    fx, fy = 300.0, 280.0
    o_C, l_C = lines.line_in_camera(*map(components, (p, q, segment.centre, segment.direction, p_BC, q_BC)))
    n_I, l_I = lines.image_line(o_C, l_C, fx, fy)
    place, depth = lines.segment_place(*lines.image_line(o_C, l_C), o_C, segment.half_length)

    R_WC = so3.quat_to_matrix(q) @ so3.quat_to_matrix(q_BC)
    p_WC = p + so3.quat_to_matrix(q) @ p_BC
    s = np.linspace(-40, 40, 400_001)
    points_C = (segment.centre + s[:, None] * segment.direction - p_WC) @ R_WC
    pixels = points_C[:, :2] * [fx, fy] / points_C[:, 2:]
    off_centre = np.linalg.norm(pixels, axis=1)
    nearest = int(np.argmin(off_centre))
    assert abs(lines.reprojection_error(n_I)) == pytest.approx(off_centre[nearest], rel=2e-3, abs=0.5)
    in_front = points_C[nearest, 2] > 0
    assert (lines.cheirality(n_I, l_I) > 0) == in_front
    central = int(np.argmin(np.linalg.norm(points_C[:, :2] / points_C[:, 2:], axis=1)))  # in units of the focal length
    if 0 < central < len(s) - 1:
        assert place / depth * segment.half_length == pytest.approx(s[central], abs=2e-3 * max(1.0, abs(s[central])))


@pytest.mark.parametrize("seed", range(20))
def test_the_segments_place_is_the_papers_constraint(seed: int) -> None:
    """-(p3D - e1) . (p3D - e2) > 0 of [P:eq13], with p3D = p2D / d3D_z of [P:eq11], as printed."""
    rng = np.random.default_rng(250 + seed)
    o_C, l_C, half = rng.normal(size=3), rng.normal(size=3), rng.uniform(0.2, 3.0)
    l_C /= np.linalg.norm(l_C)
    n_I, l_I = lines.image_line(tuple(o_C), tuple(l_C))
    p2D, d3D = (stack(v) for v in lines.centre_points(n_I, l_I))
    p3D = p2D / d3D[2]
    place, depth = lines.segment_place(n_I, l_I, tuple(o_C), half)
    np.testing.assert_allclose(p3D, o_C + place / depth * half * l_C, rtol=1e-9, atol=1e-9)
    assert (abs(place) < abs(depth)) == (-(p3D - o_C + half * l_C) @ (p3D - o_C - half * l_C) > 0)


@pytest.mark.parametrize("seed", range(5))
def test_casadi_symbols_and_arrays_give_the_same_numbers(seed: int) -> None:
    rng = np.random.default_rng(300 + seed)
    poses = [random_pose(rng) for _ in range(7)]
    segment = random_segment(rng)
    x = ca.SX.sym("x", 7)
    xs = components(x)
    line = (components(segment.centre), components(segment.direction))
    symbolic = ca.Function("h", [x], [lines.segment_clearance(xs[:3], xs[3:], *line, segment.half_length, 0.03, RADII)])
    batch = np.array([np.concatenate(pose) for pose in poses])
    numeric = lines.segment_clearance(components(batch[:, :3]), components(batch[:, 3:]), *line, segment.half_length,
                                      0.03, RADII)
    np.testing.assert_allclose([float(symbolic(row)) for row in batch], numeric, rtol=1e-10)


@pytest.mark.parametrize("seed", range(30))
def test_segment_distance_matches_sampling(seed: int) -> None:
    rng = np.random.default_rng(400 + seed)
    a, b = random_segment(rng), random_segment(rng)
    s = np.linspace(-a.half_length, a.half_length, 4001)
    sampled = b.distance(a.centre + s[:, None] * a.direction).min()
    assert lines.segment_distance(a, b) == pytest.approx(sampled, abs=2e-3)
    assert lines.segment_distance(a, b) == pytest.approx(lines.segment_distance(b, a), abs=1e-9)


@pytest.mark.parametrize("bad", [
    dict(centre=[0, np.nan, 0]), dict(direction=[0, 0, 0]), dict(half_length=0.0), dict(radius=-0.1),
])
def test_unusable_segments_are_refused(bad: dict) -> None:
    with pytest.raises(PerchError, match="line 4"):
        Segment(**{**dict(centre=[0, 0, 1], direction=[0, 1, 0], half_length=1.0, radius=0.03, id=4), **bad})
