"""The perching surface's frame, against the definitions in docs/interface.md."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface

ANGLE = st.floats(0.0, np.pi)
HEADING = st.floats(-3.1, 3.1)


@given(ANGLE, HEADING)
def test_frame_is_a_body_pitched_forward_and_up_by_the_inclination(inclination, heading):
    """b3 = s3 at contact: a level vehicle at the heading, pitched nose up by the inclination (FLU: -pitch about b2)."""
    surface = PerchSurface.from_inclination([1.0, 2.0, 3.0], inclination, heading)
    expected = Rotation.from_euler("ZY", [heading, -inclination]).as_matrix()
    np.testing.assert_allclose(surface.R_WS, expected, atol=1e-12)
    assert np.cos(surface.heading - heading) == pytest.approx(1.0)


def test_wall_faces_the_approach_and_s1_points_up():
    wall = PerchSurface.from_inclination([3.0, 0.0, 1.5], np.pi / 2)
    np.testing.assert_allclose(wall.normal, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(wall.R_WS[:, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(wall.R_WS[:, 1], [0, 1, 0], atol=1e-12)


@given(ANGLE, HEADING, st.tuples(*[st.floats(-5, 5)] * 3))
def test_points_go_there_and_back(inclination, heading, point):
    surface = PerchSurface.from_inclination([1.0, -2.0, 0.5], inclination, heading, size=(0.6, 0.4))
    point_S = surface.to_surface(point)
    np.testing.assert_allclose(surface.p_WS + surface.R_WS @ point_S, point, atol=1e-9)
    assert surface.distance(point) == pytest.approx(point_S[2])
    assert surface.covers(point) == (abs(point_S[0]) <= 0.3 and abs(point_S[1]) <= 0.2)


@pytest.mark.parametrize("arguments, key", [
    (([0, 0, 0], -0.1), "inclination"), (([0, 0, np.nan], 1.0), "p_WS"), (([0, 0, 0], 1.0, 0.0, (0.6, 0.0)), "size")])
def test_impossible_surfaces_are_refused(arguments, key):
    with pytest.raises(ConfigError, match=key):
        PerchSurface.from_inclination(*arguments)
