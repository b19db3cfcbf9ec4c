"""Body states at image stamps, and pixels of images."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import PinholeCamera
from perch_core.values import CameraImage
from perch_perception.images import ImageError, image_array, mono_image, rgb_image
from perch_perception.pose_buffer import BodyState, PoseBuffer, StampError
from scipy.spatial.transform import Rotation, Slerp


def state(t, v=(2.0, 0.0, -1.0), w=(0.0, 3.0, 0.0)):
    v, w = np.array(v), np.array(w)
    return BodyState(t, v * t, so3.quat_exp(w * t), v, w, np.eye(6) * (1e-4 + 1e-3 * t))


def test_interpolates_position_attitude_and_covariance():
    buffer = PoseBuffer()
    for k in range(100):
        assert buffer.add(state(0.002 * k))
    for t in (0.0, 0.0507, 0.1, 0.1973):
        body = buffer.at(t)
        np.testing.assert_allclose(body.p_WB, np.array([2.0, 0.0, -1.0]) * t, atol=1e-12)
        np.testing.assert_allclose(body.R_WB, Rotation.from_rotvec([0, 3.0 * t, 0]).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(body.covariance, np.eye(6) * (1e-4 + 1e-3 * t), atol=1e-12)
    slerp = Slerp([0, 0.04], Rotation.from_rotvec([[0.1, 0.2, 0.3], [-0.4, 0.5, 0.0]]))
    other = PoseBuffer()
    for t in (0.0, 0.04):
        other.add(BodyState(t, np.zeros(3), slerp(t).as_quat(), np.zeros(3), np.zeros(3)))
    np.testing.assert_allclose(other.at(0.013).R_WB, slerp(0.013).as_matrix(), atol=1e-12)


@pytest.mark.parametrize(("stamp", "why"), [(-0.1, "older"), (0.3, "ahead of"), (0.16, "gap of 100 ms")])
def test_a_stamp_without_a_state_is_refused_with_the_reason(stamp, why):
    buffer = PoseBuffer()
    with pytest.raises(StampError, match="no odometry yet"):
        buffer.at(0.0)
    for k in range(51):
        buffer.add(state(0.002 * k))
    buffer.add(state(0.2))
    with pytest.raises(StampError, match=why):
        buffer.at(stamp)


def test_a_state_whose_covariance_is_none_is_refused_at_its_stamp_and_those_beside_it_are_used():
    buffer = PoseBuffer()
    for k in range(4):
        buffer.add(state(0.02 * k) if k != 1 else replace(state(0.02 * k), covariance=np.diag([1e-4] * 5 + [-1e-4])))
    for stamp in (0.02, 0.021):
        with pytest.raises(StampError, match="the odometry's covariance a variance of -"):
            buffer.at(stamp)
    assert buffer.at(0.05).p_WB == pytest.approx(0.05 * np.array([2.0, 0.0, -1.0]))


def test_refuses_states_that_go_back_or_are_not_finite_and_forgets_old_ones():
    buffer = PoseBuffer()
    assert buffer.newest == -np.inf
    assert buffer.add(state(1.0))
    assert not buffer.add(state(1.0)) and not buffer.add(state(0.9))
    assert not buffer.add(state(1.1, v=(np.nan, 0, 0)))
    np.testing.assert_array_equal(buffer.at(1.0).p_WB, state(1.0).p_WB)
    for t in np.arange(1.002, 2.5, 0.002):
        buffer.add(state(t))
    assert len(buffer) <= 502
    with pytest.raises(StampError, match="older"):
        buffer.at(1.4)


def image(pixels, encoding, **changes):
    fields = dict(stamp=0, frame="", width=8, height=4, encoding=encoding, pixels=pixels)
    return CameraImage(**{**fields, **changes})


def test_pixels_of_images():
    camera = PinholeCamera(width=8, height=4, fx=5, fy=5, cx=4, cy=2)
    rgb = np.arange(8 * 4 * 3, dtype=np.uint8).reshape(4, 8, 3)
    grey = rgb @ [0.299, 0.587, 0.114]
    np.testing.assert_array_equal(rgb_image(image(rgb, "rgb8"), camera), rgb)
    np.testing.assert_allclose(mono_image(image(rgb, "rgb8"), camera), grey, atol=1.0)
    np.testing.assert_array_equal(rgb_image(image(rgb, "bgr8"), camera), rgb[..., ::-1])
    np.testing.assert_allclose(mono_image(image(rgb[..., ::-1], "bgr8"), camera), grey, atol=1.0)
    np.testing.assert_array_equal(mono_image(image(rgb[..., 0], "mono8"), camera), rgb[..., 0])
    with pytest.raises(ImageError, match="no colour"):
        rgb_image(image(rgb[..., 0], "mono8"), camera)
    mono = rgb[..., 0]
    for change, why in (({"encoding": "16UC1"}, "16UC1"), ({"width": 9}, "9 x 4"), ({"pixels": mono[:2]}, "are not mono8"),
                        ({"pixels": lambda region: None}, "no pixels"), ({"encoding": "rgb8"}, "are not rgb8")):
        with pytest.raises(ImageError, match=why):
            image_array(image(**{**dict(pixels=mono, encoding="mono8"), **change}), camera)


def test_only_the_region_asked_for_is_drawn():
    camera, asked = PinholeCamera(width=8, height=4, fx=5, fy=5, cx=4, cy=2), []

    def draw(region):
        asked.append(region)
        return np.zeros((4, 8), np.uint8)

    region = (slice(1, 3), slice(2, 5))
    mono_image(image(draw, "mono8"), camera, region)
    assert asked == [region]
