"""The place to perch on a mapped cable: which line, which point, which way b3 points. [P:VI-B]"""

import numpy as np
import pytest

from perch_core import so3
from perch_core.values import MappedPowerline, PowerlineMap
from perch_core.values.limits import PLAN_LINES_MAX
from perch_control.mission.line_target import mapped_target
from perch_control.mission.values import Goal


def mapped(id, start, end):
    return MappedPowerline(id, start, end, 0.03, np.diag([1e-4, 4e-4, 1e-4]), 0.01, 20)


LINES = [mapped(3, (4.0, -2.0, 4.25), (4.0, 2.0, 4.25)), mapped(7, (5.0, 2.0, 3.75), (5.0, -2.0, 3.75))]
VEHICLE = np.array([0.0, 0.0, 4.2])


def target_of(lines, point, pitch, vehicle=VEHICLE):
    goal = Goal(4.2, 30.0, perch_point=np.array(point, float), perch_pitch=pitch)
    return mapped_target(PowerlineMap(1_500_000_000, tuple(lines), False, ""), goal, np.array(vehicle, float))


def b3_of(target):
    return so3.quat_rotate(target.q_WS, np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("pitch, expected", [(0.0, [0, 0, 1]), (np.pi / 2, [-1, 0, 0]), (np.pi, [0, 0, -1])])
@pytest.mark.parametrize("line", LINES)
def test_b3_leans_from_the_line_towards_the_vehicle(line, pitch, expected):
    point = line.segment.closest_point(np.array([4.5, 0.3, 4.0]))
    target = target_of(LINES, point, pitch)
    assert target.line == line.id and target.lines == tuple(LINES) and target.time == 1.5 and target.position_sigma == pytest.approx(0.02)
    assert np.allclose(target.p_WS, point)
    assert np.allclose(b3_of(target), expected, atol=1e-9)
    assert np.allclose(so3.quat_rotate(target.q_WS, np.array([0.0, 1.0, 0.0])), line.segment.direction)


def test_the_published_90_degree_problem_has_the_same_attitude():
    # reference problem deg90: the vehicle comes from +x, b3 at the perch is +x
    target = target_of([mapped(0, (-3.0, -2.0, 4.25), (-3.0, 2.0, 4.25))], (-3.0, 0.0, 4.25), np.pi / 2, (1.0, 0.0, 4.2))
    assert np.allclose(b3_of(target), [1, 0, 0])


def test_points_beyond_the_ends_are_brought_to_the_line():
    assert np.allclose(target_of(LINES, (4.0, 2.2, 4.25), 1.0).p_WS, [4.0, 2.0, 4.25])


def test_no_line_near_the_point_is_no_target():
    assert target_of(LINES, (0.0, 0.0, 0.0), 1.0) is None
    assert target_of([], (4.0, 0.0, 4.25), 1.0) is None


def test_of_a_long_flights_map_the_nearest_lines_are_planned_among():
    far = [mapped(100 + k, (4.0 + 5.0 * k, -2.0, 4.25), (4.0 + 5.0 * k, 2.0, 4.25)) for k in range(1, 150)]
    target = target_of([*reversed(far), *LINES], (4.0, 0.0, 4.25), 1.0)
    assert target.line == 3 and {3, 7} <= {line.id for line in target.lines} and len(target.lines) == PLAN_LINES_MAX
    assert max(line.segment.centre[0] for line in target.lines) < 4.0 + 5.0 * PLAN_LINES_MAX


def test_the_line_is_chosen_by_the_distance_from_each_segment():
    rng = np.random.default_rng(1)
    lines = [mapped(k, *map(tuple, rng.uniform(-1.0, 1.0, (2, 3)) * (1.0, 1.0, 0.1))) for k in range(20)]
    for point in rng.uniform(-1.2, 1.2, (40, 3)) * (1.0, 1.0, 0.5):
        distances = [float(line.segment.distance(point)) for line in lines]
        target = target_of(lines, point, 1.0)
        assert (target.line if target else None) == (int(np.argmin(distances)) if min(distances) < 0.4 else None)


def test_a_vertical_line_is_no_target():
    """A tilt about it means nothing."""
    assert target_of([mapped(0, (4.0, 0.0, 2.0), (4.0, 0.0, 6.0))], (4.0, 0.0, 4.25), 1.0) is None
