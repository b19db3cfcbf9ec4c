"""Target localiser and powerline mapper as components: images that wait, cameras that become known, and every fault of the inputs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from perch_core.camera import PinholeCamera, RadialTangentialCamera
from perch_core.config import from_mapping
from perch_core.errors import ConfigError
from perch_core.so3 import exp, quat_from_matrix
from perch_core.values import CameraImage, CameraModel, OdometryState, Transform
from perch_core.vehicle import load_vehicle
from perch_perception.camera_component import MAX_QUEUED
from perch_perception.mounted_camera import MountedCamera
from perch_perception.powerline_mapper import PowerlineMapper, PowerlineMapperConfig
from perch_perception.tags import Localization
from perch_perception.tags.pose import BoardPose
from perch_perception.target_localizer import TargetLocalizer, TargetLocalizerConfig

from unit.component_outputs import Outputs

MS = 1_000_000
FRONT = load_vehicle("snapdragon").mounts["front"]
CAMERA = FRONT.camera
FRAME = "camera_front_optical_frame"
EXPOSED = -round(FRONT.stamp_offset * 1e9)  # middle of the exposure after the stamp [ns]
OTHER = RadialTangentialCamera(CAMERA.width, CAMERA.height, 400.0, 400.0, 320.0, 240.0, (-0.1, 0.01, 0.0, 0.0, 0.0))


class Blind:
    """In the place of the localiser: remembers what it was asked."""

    def __init__(self):
        self.asked = []

    def process(self, image, exposed, body):
        self.asked.append((image(None), exposed, body))
        return Localization(None, message="blind")


def picture(stamp, camera=CAMERA, encoding="mono8", **changes):
    shape = (camera.height, camera.width) + ((3,) if encoding.endswith(("b8", "r8", "C3")) else ())
    arguments = dict(stamp=stamp, frame=FRAME, width=camera.width, height=camera.height, encoding=encoding, pixels=np.zeros(shape, np.uint8))
    return CameraImage(**{**arguments, **changes})


def odometry(stamp, **changes):
    value = OdometryState(stamp, (0.001 * (stamp // MS), 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0),
                          np.eye(6) * 1e-4, np.eye(6) * 1e-4)
    return value._replace(**changes)


class Bench:
    """A localiser with a blind eye."""

    def __init__(self, known=True, **parameters):
        self.eye = Blind()
        self.component = TargetLocalizer(from_mapping(TargetLocalizerConfig, parameters, "target_localizer"), self.eye)
        self.out = Outputs(self.component)
        if known:
            self.component.on_camera_info(CameraModel(0, FRAME, CAMERA))

    def odometry(self, begin, end):
        """500 Hz from `begin` to `end` [ms]."""
        for ms in range(begin, end + 1, 2):
            self.component.on_odometry(odometry(ms * MS))

    def image(self, ms, **changes):
        self.component.on_image(picture(ms * MS, **changes))

    @property
    def exposures(self):
        return [round(exposed * 1e3) for _, exposed, _ in self.eye.asked]


def test_an_image_waits_for_the_odometry_after_its_exposure():
    bench = Bench()
    bench.odometry(0, 100)
    bench.image(98)  # exposed at 106 ms
    assert bench.exposures == []
    bench.odometry(102, 104)
    assert bench.exposures == []
    bench.odometry(106, 106)
    assert bench.exposures == [98 + EXPOSED // MS]
    _, exposed, body = bench.eye.asked[0]
    assert body.p_WB[0] == pytest.approx(exposed) and body.time == pytest.approx(exposed)
    [sighting] = bench.out["sighting"]
    assert (sighting.stamp, sighting.found, sighting.message) == (round(exposed * 1e9), False, "blind")


def test_the_order_of_arrival_between_images_and_odometry_does_not_matter():
    early, late = Bench(), Bench()
    early.image(98), early.odometry(0, 200)
    late.odometry(0, 200), late.image(98)
    (_, a, before), (_, b, after) = early.eye.asked[0], late.eye.asked[0]
    assert a == b and before.p_WB.tobytes() == after.p_WB.tobytes()


def test_repeated_images_and_those_of_another_time_are_told_and_do_not_spoil_the_order():
    bench = Bench()
    bench.odometry(0, 300)
    for ms in (100, 100, 50, 5000, 150):
        bench.image(ms)
    assert bench.exposures == [100 + EXPOSED // MS, 150 + EXPOSED // MS]
    messages = [s.message for s in bench.out["sighting"]]
    assert "not newer" in messages[1] and "not newer" in messages[2] and "ahead of the odometry" in messages[3]


def test_the_average_of_an_image_is_taken_once_it_is_good():
    """A poor one, from far away, is waited over."""
    bench = Bench(mode="average")
    seen = iter((0.3, 0.3, 0.01, 0.01))

    def process(image, exposed, body):
        pose = BoardPose(np.array([0.0, 0.0, 2.0]), np.eye(3), next(seen) ** 2 * np.eye(6), (0, 1, 2, 3), 0.1, np.zeros((6, 4)))
        return Localization(pose, pose, complete=True)

    bench.eye.process = process
    bench.odometry(0, 400)
    for ms in (50, 100, 150, 200):
        bench.image(ms)
    assert [one.found for one in bench.out["sighting"]] == [True] * 4 and len(bench.out["pose"]) == 1
    assert [one.method for one in bench.out["sighting"]] == ["average"] * 4


@pytest.mark.parametrize("given", [{"twist_covariance": np.zeros((6, 6))}, {"twist_covariance": -np.eye(6)}])
def test_the_motion_of_odometry_without_a_twist_is_no_jump(given):
    """A turn by 1 rad/s at 3 m/s; motion capture often gives poses alone."""
    bench = Bench()
    for ms in range(0, 1000, 2):
        q = (0.0, 0.0, math.sin(0.0005 * ms), math.cos(0.0005 * ms))
        bench.component.on_odometry(odometry(ms * MS, p_WB=(0.003 * ms, 0.0, 1.0), q_WB=q, v_B=(0.0, 0.0, 0.0), **given))
    body = bench.component.bodies.at(0.95)
    assert body.v_WB == pytest.approx([3.0, 0.0, 0.0]) and body.w_WB_B == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    assert body.corrected == pytest.approx(np.zeros(3), abs=0.01)


def test_the_queue_is_bounded():
    bench = Bench()
    for k in range(MAX_QUEUED + 5):
        bench.image(100 + 10 * k)
    assert bench.component.dropped == 5
    assert any("dropped" in text for text in bench.out.warnings())
    bench.odometry(0, 400)
    assert len(bench.exposures) == MAX_QUEUED and bench.exposures[0] == 150 + EXPOSED // MS


def test_images_that_cease_are_named():
    """The diagnostics of the last image would be repeated for ever."""
    bench = Bench()
    bench.odometry(0, 1000), bench.image(990), bench.odometry(1002, 2998)
    assert not any("no image" in text for text in bench.out.warnings())
    bench.odometry(3000, 3000)
    last = bench.out["diagnostics"][-1]
    assert (last.level, last.message) == (1, "camera_front/image_raw: no image for 2 s") and last.message in bench.out.warnings()


def test_odometry_that_never_comes_is_named():
    for component in (Bench().component, mapper()[0]):
        out = Outputs(component)
        for k in range(MAX_QUEUED + 1):
            assert out.warnings() == []
            component.on_image(picture(k * 100 * MS, encoding="rgb8"))
        assert len(out.warnings()) == 1 and "no odometry yet" in out.warnings()[0]


@pytest.mark.parametrize("bad", [
    dict(p_WB=(math.nan, 0.0, 0.0)), dict(q_WB=(0.0, 0.0, 0.0, 0.0)), dict(frame="camera"), dict(pose_covariance=np.eye(6) * 1e300),
    dict(pose_covariance=-np.eye(6)), dict(pose_covariance=np.full((6, 6), np.nan)), dict(pose_covariance=np.eye(3)),
    dict(v_B=(0.0, math.inf, 0.0))])
def test_bad_odometry_is_dropped_with_a_warning(bad):
    bench = Bench()
    bench.odometry(0, 100)
    bench.component.on_odometry(odometry(102 * MS, **bad))
    assert bench.out.warnings()
    bench.image(93)  # exposed at 101 ms
    assert bench.exposures == []
    bench.odometry(104, 104)
    assert bench.exposures == [101]
    assert np.isfinite(bench.eye.asked[0][2].covariance).all()


@pytest.mark.parametrize("jump", [-2_000, 3_600_000])
def test_odometry_that_was_started_again_is_followed(jump):
    """One wrong stamp changes nothing; a new stream is believed after a few, and images of its time are used."""
    bench = Bench()
    bench.odometry(5000, 6000)
    bench.image(5900)
    bench.component.on_odometry(odometry((6000 + jump) * MS))
    bench.odometry(6002, 6010)
    bench.image(5990)
    assert len(bench.exposures) == 2
    bench.odometry(6002 + jump, 6200 + jump)
    assert any("restarting" in text for text in bench.out.warnings())
    bench.image(6100 + jump)
    assert bench.exposures[-1] == 6100 + jump + EXPOSED // MS


def test_images_wait_for_camera_info():
    bench = Bench(known=False)
    bench.odometry(0, 200)
    bench.image(100)
    assert bench.exposures == [] and any("camera_front/camera_info" in text for text in bench.out.warnings())
    bench.component.on_camera_info(CameraModel(100 * MS, FRAME, CAMERA))
    assert bench.exposures == [100 + EXPOSED // MS]
    assert bench.component.mounted.mount is bench.component.mounted.nominal  # the calibrated camera itself: caches stay


@pytest.mark.parametrize(("info", "image", "warned"), [
    (FRAME, FRAME, ()), (FRAME, "", ()), ("", "tail", ()), ("", "", ()), (FRAME, "tail", ("image_raw: frame 'tail' is not 'camera_front_optical_frame'",)),
    ("tail", "tail", ("camera_info: frame 'tail' is not 'camera_front_optical_frame'",))])
def test_a_wrong_frame_of_a_camera_is_named_and_the_image_used(info, image, warned):
    bench = Bench(known=False)
    bench.component.on_camera_info(CameraModel(0, info, CAMERA))
    bench.odometry(0, 200)
    bench.image(100, frame=image)
    assert len(bench.exposures) == 1 and [text.partition("/")[2].partition(", ")[0] for text in bench.out.warnings()] == list(warned)


def test_another_camera_is_believed_when_it_stays():
    bench = Bench()
    bench.component.on_camera_info(CameraModel(1, FRAME, OTHER))
    bench.component.on_camera_info(CameraModel(2, FRAME, CAMERA))
    assert bench.component.mounted.mount.camera == CAMERA
    for _ in range(10):  # two that contradict each other: the first one holds
        bench.component.on_camera_info(CameraModel(3, FRAME, OTHER))
        bench.component.on_camera_info(CameraModel(3, FRAME, CAMERA))
    assert bench.component.mounted.mount.camera == CAMERA
    for _ in range(10):
        bench.component.on_camera_info(CameraModel(4, FRAME, OTHER))
    assert bench.component.mounted.mount.camera == OTHER
    assert any("the camera has changed" in text for text in bench.out.warnings())


@pytest.mark.parametrize("changes", [
    dict(encoding="16UC1"), dict(width=320), dict(pixels=np.zeros((10, 10), np.uint8)), dict(pixels=lambda region: None),
    dict(encoding="rgb8", pixels=np.zeros((480, 640), np.uint8)), dict(pixels=np.zeros((480, 640), np.float32))])
def test_an_image_of_another_kind_is_told(changes):
    bench = Bench()
    bench.odometry(0, 200)
    bench.image(100, **changes)
    [sighting] = bench.out["sighting"]
    assert "image:" in sighting.message and not sighting.found
    bench.image(130)
    assert bench.out["sighting"][-1].message == "blind"


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgr8"])
def test_every_encoding_is_looked_at_in_grey(encoding):
    bench = Bench()
    bench.odometry(0, 200)
    pixels = np.zeros((480, 640, 3), np.uint8)
    pixels[..., 0 if encoding == "rgb8" else 2] = 200  # red
    grey = np.full((480, 640), 60, np.uint8)
    bench.component.on_image(picture(100 * MS, encoding=encoding, pixels=grey if encoding == "mono8" else pixels))
    assert bench.eye.asked[0][0].shape == (480, 640)
    assert abs(int(bench.eye.asked[0][0][0, 0]) - 60) <= 1


def test_extrinsics_by_transforms():
    bench = Bench(extrinsics="tf")
    bench.odometry(0, 200)
    bench.image(100)
    assert bench.exposures == [] and any("/tf_static" in text for text in bench.out.warnings())
    upright = (0.0, 0.0, 0.0, 1.0)
    bench.component.on_transform(Transform("camera_link", FRAME, (0.0, 0.0, 0.0), tuple(quat_from_matrix(FRONT.R_BC).tolist())))
    assert bench.exposures == []
    bench.component.on_transform(Transform("base_link", "camera_link", (0.5, 0.0, 0.1), upright))
    assert len(bench.exposures) == 1
    np.testing.assert_allclose(bench.component.mounted.mount.p_BC, (0.5, 0.0, 0.1))
    np.testing.assert_allclose(bench.component.mounted.mount.R_BC, FRONT.R_BC, atol=1e-12)


def test_differences_that_nobody_can_measure_are_no_other_camera():
    """Intrinsics within 1e-6, extrinsics within 1 um and 1 urad; what is larger is another camera."""
    mounted = MountedCamera(FRONT, False, "tf", lambda text, period: None)
    place = Transform("base_link", FRAME, (0.1, 0.0, 0.0), tuple(quat_from_matrix(FRONT.R_BC).tolist()))
    mounted.take_transform(place)
    assert mounted.take_model(CameraModel(0, FRAME, CAMERA))
    mount, turn = mounted.mount, quat_from_matrix(FRONT.R_BC @ exp(np.array([0.0, 5e-7, 0.0])))
    almost = replace(CAMERA, fx=CAMERA.fx * (1.0 + 5e-7), coefficients=tuple(c + 1e-9 for c in CAMERA.coefficients))
    assert not any(mounted.take_model(CameraModel(k, FRAME, almost)) for k in range(10))
    assert not mounted.take_transform(place._replace(p=(0.1 + 5e-7, 0.0, 0.0))) and not mounted.take_transform(place._replace(q=tuple(turn)))
    assert mounted.mount is mount
    assert mounted.take_transform(place._replace(p=(0.101, 0.0, 0.0)))
    assert any(mounted.take_model(CameraModel(k, FRAME, replace(CAMERA, fx=CAMERA.fx * 1.001))) for k in range(10))


def test_a_camera_that_repeats_its_intrinsics_costs_no_arrays(monkeypatch):
    mounted = MountedCamera(FRONT, False, "file", lambda text, period: None)
    mounted.take_model(CameraModel(0, FRAME, replace(CAMERA, fx=CAMERA.fx * 1.1)))
    monkeypatch.setattr("perch_perception.mounted_camera.astuple", lambda camera: pytest.fail("compared number by number"))
    for k in range(1, 3):
        assert not mounted.take_model(CameraModel(k, FRAME, replace(CAMERA, fx=CAMERA.fx * 1.1)))


def test_another_frame_is_believed_when_it_stays():
    mounted = MountedCamera(FRONT, False, "tf", lambda text, period: None)
    for frame, x in ((FRAME, 0.1), ("tail", -0.1)):
        mounted.take_transform(Transform("base_link", frame, (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    mounted.take_model(CameraModel(0, FRAME, CAMERA))
    assert not mounted.take_model(CameraModel(1, "tail", CAMERA)) and not mounted.take_model(CameraModel(2, FRAME, CAMERA))
    assert [mounted.take_model(CameraModel(3, "tail", CAMERA)) for _ in range(6)] == [False] * 4 + [True, False]
    assert mounted.mount.p_BC[0] == -0.1


def test_images_of_another_frame_wait_for_its_transform():
    """They are of a camera whose place is not known; with the transform they are used, with this place."""
    bench, upright = Bench(known=False, extrinsics="tf"), (0.0, 0.0, 0.0, 1.0)
    bench.component.on_transform(Transform("base_link", FRAME, (0.1, 0.0, 0.0), upright))
    bench.component.on_camera_info(CameraModel(0, FRAME, CAMERA))
    bench.odometry(0, 400)
    bench.image(50)
    assert len(bench.exposures) == 1
    for k in range(5):
        bench.component.on_camera_info(CameraModel(k, "tail", CAMERA))
    bench.image(100, frame="tail")
    assert len(bench.exposures) == 1 and bench.component.mounted.mount is None
    assert "images are not used: no transform of 'tail' in base_link on /tf_static yet" in bench.out.warnings()[-1]
    bench.component.on_transform(Transform("base_link", "tail", (-0.1, 0.0, 0.0), upright))
    assert len(bench.exposures) == 2 and bench.component.mounted.known.p_BC[0] == -0.1


def test_a_camera_that_is_found_again_in_its_place_is_the_same():
    """A new tree of frames comes link by link: what was made for the camera holds."""
    mounted, upright = MountedCamera(FRONT, False, "tf", lambda text, period: None), (0.0, 0.0, 0.0, 1.0)
    mounted.take_transform(Transform("base_link", FRAME, (0.1, 0.0, 0.0), upright))
    assert mounted.take_model(CameraModel(0, FRAME, CAMERA))
    mount = mounted.mount
    assert not mounted.take_transform(Transform("arm", FRAME, (0.0, 0.0, 0.0), upright)) and mounted.mount is None
    assert mounted.take_transform(Transform("base_link", "arm", (0.1, 0.0, 0.0), upright)) and mounted.mount is mount


@pytest.mark.parametrize(("cls", "parameters"), [
    (TargetLocalizer, {"camera": "tail"}), (PowerlineMapper, {"vehicle": "snapdragon"}), (PowerlineMapper, {"camera": "tail"})])
def test_a_camera_that_cannot_be_used_is_refused_at_the_start(cls, parameters):
    with pytest.raises(ConfigError, match="usable"):
        cls(from_mapping(cls.config_type, parameters, "node"))


# -- powerline mapper ------------------------------------------------------------------------------------------------------


def mapper(**parameters):
    component = PowerlineMapper(from_mapping(PowerlineMapperConfig, parameters, "powerline_mapper"))
    mount = load_vehicle("rpg").mounts["front"]
    component.on_camera_info(CameraModel(0, FRAME, mount.camera))
    return component, Outputs(component), mount


def test_the_mapper_takes_so_many_images_a_second():
    component, out, mount = mapper(rate=10.0)
    for ms in range(0, 1100, 2):
        component.on_odometry(odometry(ms * MS))
        if ms % 34 == 0:
            component.on_image(picture(ms * MS, mount.camera, "rgb8"))
    gaps = np.diff([m.stamp for m in out["powerlines"]]) / MS
    assert 9 <= len(out["powerlines"]) <= 11 and gaps.min() > 95
    assert out["powerlines"][-1].lines == ()


@pytest.mark.parametrize(("odometries", "encoding", "why"), [
    (dict(pose_covariance=np.eye(6) * 9.0), "rgb8", "mapping paused"), ({}, "mono8", "no colour"), ({}, "16UC1", "encoding")])
def test_the_mapper_says_why_an_image_was_not_used(odometries, encoding, why):
    component, out, mount = mapper()
    for ms in range(0, 200, 2):
        component.on_odometry(odometry(ms * MS, **odometries))
    component.on_image(picture(100 * MS, mount.camera, encoding))
    assert why in out["powerlines"][0].message
    assert any(why in text for text in out.warnings())


def test_the_mapper_works_in_grey_where_wires_are_dark():
    component, out, _ = mapper(detection={"appearance": "plain"})
    for ms in range(0, 200, 2):
        component.on_odometry(odometry(ms * MS))
    component.on_image(picture(100 * MS, load_vehicle("rpg").mounts["front"].camera, "mono8"))
    assert out["powerlines"][0].message == ""
    assert out.warnings() == []


def test_a_camera_without_distortion_will_do():
    component = TargetLocalizer(TargetLocalizerConfig())
    out = Outputs(component)
    component.on_camera_info(CameraModel(0, FRAME, PinholeCamera(320, 240, 200.0, 200.0, 160.0, 120.0)))
    for ms in range(0, 200, 2):
        component.on_odometry(odometry(ms * MS))
    component.on_image(picture(100 * MS, PinholeCamera(320, 240, 200.0, 200.0, 160.0, 120.0)))
    assert out["sighting"][0].message == "no tag of the board found"
