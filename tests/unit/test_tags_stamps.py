"""Body states at image stamps, images that wait for them, and pixels out of messages."""

from types import SimpleNamespace

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import PinholeCamera
from perch_perception.images import ImageError, image_array, mono_image, rgb_image
from perch_perception.pending_images import PendingImages
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


def test_refuses_states_that_go_back_or_are_not_finite_and_forgets_old_ones():
    buffer = PoseBuffer(span=0.5, reach=0.004)
    assert buffer.newest == -np.inf
    assert buffer.add(state(1.0))
    assert not buffer.add(state(1.0)) and not buffer.add(state(0.9))
    assert not buffer.add(state(1.1, v=(np.nan, 0, 0)))
    np.testing.assert_allclose(buffer.at(1.003).p_WB, state(1.003).p_WB, atol=1e-12)
    for t in np.arange(1.002, 2.5, 0.002):
        buffer.add(state(t))
    assert len(buffer) <= 252
    with pytest.raises(StampError, match="older"):
        buffer.at(1.5)


def image(ns):
    return SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=ns // 10**9, nanosec=ns % 10**9)))


def test_an_image_waits_for_the_odometry_after_its_exposure():
    handled = []
    pending = PendingImages(-0.008, lambda msg, exposed, why: handled.append((round(exposed, 6), why)))
    pending.add(image(100_000_000), 0.1, keep_all=True)  # exposed at 0.108 s
    assert handled == []
    pending.advance(0.106)
    assert handled == []
    pending.advance(0.108)
    assert handled == [(0.108, "")]


def test_every_image_is_answered_once_also_the_bad_ones():
    handled = []
    pending = PendingImages(0.0, lambda msg, exposed, why: handled.append((exposed, why)))
    for ns in (100, 100, 50, 5000):  # ms: repeated, back in time, far in the future
        pending.add(image(ns * 1_000_000), 0.2, keep_all=True)
    assert [h[0] for h in handled] == [0.1, 0.1, 0.05, 5.0]
    assert handled[0][1] == ""
    assert "not newer" in handled[1][1] and "not newer" in handled[2][1] and "ahead of the odometry" in handled[3][1]
    pending.add(image(200_000_000), 0.2, keep_all=True)  # the future stamp did not spoil the order
    assert handled[-1] == (0.2, "")


def test_real_time_drops_the_oldest_lockstep_none():
    for keep_all, dropped in ((True, 0), (False, 3)):
        handled = []
        pending = PendingImages(0.0, lambda msg, exposed, why: handled.append(why))
        for k in range(5):
            pending.add(image((100 + k) * 1_000_000), 0.0, keep_all=keep_all)
        assert (pending.dropped, len(handled)) == (dropped, dropped)
        pending.advance(1.0)
        assert len(handled) == 5


def test_pixels_of_messages():
    camera = PinholeCamera(width=8, height=4, fx=5, fy=5, cx=4, cy=2)
    rgb = np.arange(8 * 4 * 3, dtype=np.uint8).reshape(4, 8, 3)
    padded = np.zeros((4, 32), np.uint8)
    padded[:, :24] = rgb.reshape(4, 24)
    msg = SimpleNamespace(height=4, width=8, encoding="rgb8", step=32, data=padded.tobytes())
    np.testing.assert_array_equal(rgb_image(msg, camera), rgb)
    np.testing.assert_allclose(mono_image(msg, camera), rgb @ [0.299, 0.587, 0.114], atol=1.0)
    msg.encoding = "bgr8"
    np.testing.assert_array_equal(rgb_image(msg, camera), rgb[..., ::-1])
    mono = SimpleNamespace(height=4, width=8, encoding="mono8", step=8, data=rgb[..., 0].tobytes())
    np.testing.assert_array_equal(image_array(mono, camera), rgb[..., 0])
    with pytest.raises(ImageError, match="no colour"):
        rgb_image(mono, camera)
    for change, why in (({"encoding": "16UC1"}, "16UC1"), ({"width": 9}, "9 x 4"), ({"step": 4}, "too few"),
                        ({"data": b"123"}, "too few")):
        with pytest.raises(ImageError, match=why):
            image_array(SimpleNamespace(**{**mono.__dict__, **change}), camera)
