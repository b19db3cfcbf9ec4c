"""The place to perch on a mapped cable: which line, which point, which way b3 points. [P:VI-B]"""

import numpy as np
import pytest

from perch_core import so3
from perch_control.mission.line_target import MappedLine, powerline_target

LINES = [MappedLine(3, np.array([4.0, -2.0, 4.25]), np.array([4.0, 2.0, 4.25]), 0.02, 0.01),
         MappedLine(7, np.array([5.0, 2.0, 3.75]), np.array([5.0, -2.0, 3.75]), 0.02, 0.01)]
VEHICLE = np.array([0.0, 0.0, 4.2])


def b3_of(target):
    return so3.quat_rotate(target.q_WS, np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("pitch, expected", [(0.0, [0, 0, 1]), (np.pi / 2, [-1, 0, 0]), (np.pi, [0, 0, -1])])
@pytest.mark.parametrize("line", LINES)
def test_b3_leans_from_the_line_towards_the_vehicle(line, pitch, expected):
    point = line.closest(np.array([4.5, 0.3, 4.0]))
    target = powerline_target(1.0, LINES, point, pitch, VEHICLE, raw=LINES)
    assert target.line == line.id
    assert np.allclose(target.p_WS, point)
    assert np.allclose(b3_of(target), expected, atol=1e-9)
    assert np.allclose(so3.quat_to_matrix(target.q_WS) @ so3.quat_to_matrix(target.q_WS).T, np.eye(3))


def test_the_published_90_degree_problem_has_the_same_attitude():
    # reference problem deg90: the vehicle comes from +x, b3 at the perch is +x
    line = MappedLine(0, np.array([-3.0, -2.0, 4.25]), np.array([-3.0, 2.0, 4.25]), 0.01, 0.01)
    target = powerline_target(0.0, [line], np.array([-3.0, 0.0, 4.25]), np.pi / 2, np.array([1.0, 0.0, 4.2]))
    assert np.allclose(b3_of(target), [1, 0, 0])


def test_points_beyond_the_ends_are_brought_to_the_line():
    target = powerline_target(1.0, LINES, np.array([4.0, 2.2, 4.25]), 1.0, VEHICLE)
    assert np.allclose(target.p_WS, [4.0, 2.0, 4.25])


def test_no_line_near_the_point_is_no_target():
    assert powerline_target(1.0, LINES, np.array([0.0, 0.0, 0.0]), 1.0, VEHICLE) is None
    assert powerline_target(1.0, [], np.array([4.0, 0.0, 4.25]), 1.0, VEHICLE) is None
