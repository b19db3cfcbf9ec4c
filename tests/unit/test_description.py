"""Component `description`: the URDF says what the vehicle file says, and the frames are where the estimate has them."""

from math import nan
from xml.etree import ElementTree

import numpy as np
import pytest
from perch_core import config, so3
from perch_core.description import Description, DescriptionParameters
from perch_core.urdf import fixed_frames, roll_pitch_yaw, urdf
from perch_core.values import OdometryState, TargetPose
from perch_core.vehicle import load_vehicle

VEHICLES = sorted(file.stem for file in (config.config_dir() / "vehicles").glob("*.yaml"))
STEP = 2_000_000  # [ns]
ZERO = np.zeros((6, 6))


def numbers(element, name):
    return np.array([float(x) for x in element.get(name).split()])


def described(**parameters):
    """A description with what it emitted."""
    component = Description(DescriptionParameters(**parameters))
    out = {name: [] for name in ("robot_description", "static", "frames", "log")}
    for name, values in out.items():
        getattr(component, name).receivers.append(values.append)
    return component, out


def state(stamp, p=(1.0, 2.0, 3.0), q=(0.0, 0.0, 0.6, 0.8), frame="map"):
    return OdometryState(stamp, p, q, (0.0,) * 3, (0.0,) * 3, ZERO, ZERO, frame)


def test_the_urdf_has_no_encoding_declaration_which_lxml_refuses_in_text():
    assert urdf(load_vehicle("snapdragon")).startswith("<robot ")


@pytest.mark.parametrize("name", VEHICLES)
def test_the_urdf_is_the_vehicle_file(name):
    vehicle, robot = load_vehicle(name), ElementTree.fromstring(urdf(load_vehicle(name)))
    base = robot.find("link[@name='base_link']")
    assert float(base.find("inertial/mass").get("value")) == vehicle.mass
    inertia = base.find("inertial/inertia")
    J = np.array([[float(inertia.get("i" + "".join(sorted(a + b)))) for a in "xyz"] for b in "xyz"])
    np.testing.assert_array_equal(J, vehicle.inertia_matrix)
    for k, xy in enumerate(vehicle.rotor_xy):
        np.testing.assert_array_equal(numbers(base.find(f"visual[@name='rotor_{k}']/origin"), "xyz")[:2], xy)
    plate = base.find("visual[@name='perch_plate']")
    low = numbers(plate.find("origin"), "xyz")[2] - float(plate.find("geometry/cylinder").get("length")) / 2
    assert low == pytest.approx(-vehicle.perch_offset)
    np.testing.assert_allclose(numbers(base.find("collision/geometry/box"), "size"), 2 * np.array(vehicle.body_radii))


@pytest.mark.parametrize("name", VEHICLES)
def test_the_urdf_is_a_tree_whose_frames_are_the_static_transforms(name):
    vehicle, robot = load_vehicle(name), ElementTree.fromstring(urdf(load_vehicle(name)))
    links = {link.get("name") for link in robot.findall("link")}
    frames = {frame.child: frame for frame in fixed_frames(vehicle)}
    assert links == {"base_link", "imu_link", *(f"camera_{c}_optical_frame" for c in vehicle.mounts)} == {"base_link", *frames}
    for joint in robot.findall("joint"):
        frame = frames.pop(joint.find("child").get("link"))
        assert joint.find("parent").get("link") == frame.parent == "base_link"
        np.testing.assert_array_equal(numbers(joint.find("origin"), "xyz"), frame.p)
        np.testing.assert_allclose(rotation(numbers(joint.find("origin"), "rpy")), so3.quat_to_matrix(np.array(frame.q)), atol=1e-12)
    assert not frames
    materials = {m.get("name") for m in robot.findall("material")}
    assert {m.get("name") for m in robot.findall("link/visual/material")} <= materials
    for camera, mount in vehicle.mounts.items():
        frame = next(f for f in fixed_frames(vehicle) if f.child == f"camera_{camera}_optical_frame")
        np.testing.assert_allclose(frame.p, mount.p_BC)
        np.testing.assert_allclose(so3.quat_to_matrix(np.array(frame.q)), mount.R_BC, atol=1e-12)


def rotation(rpy):
    x, y, z = (so3.exp(angle * axis) for angle, axis in zip(rpy, np.eye(3)))
    return z @ y @ x


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 1.0), (0.5, -0.5, 0.5, 0.5), (0.5, 0.5, 0.5, 0.5), (0.1, 0.7, -0.1, 0.7), (-0.3, 0.2, 0.9, 0.1)])
def test_angles_are_those_of_the_quaternion(q):
    q = np.array(q) / np.linalg.norm(q)
    np.testing.assert_allclose(rotation(roll_pitch_yaw(q)), so3.quat_to_matrix(q), atol=1e-9)


def test_what_is_fixed_is_told_once():
    component, out = described()
    for now in (0, 100, 200):
        component.on_start(now)
    assert len(out["robot_description"]) == 1
    assert [(f.parent, f.child) for f in out["static"]] == [
        ("map", "odom"), ("base_link", "imu_link"), ("base_link", "camera_down_optical_frame"), ("base_link", "camera_front_optical_frame")]


@pytest.mark.parametrize("period", [STEP, 1_000_000, 10_000_000, 7_000_000])
def test_the_body_is_told_at_50_hz_whatever_the_rate_of_the_odometry(period):
    component, out = described()
    stamps = range(0, 2_000_000_000, period)
    for stamp in stamps:
        component.on_odometry(state(stamp))
    times = [f.stamp for f in out["frames"]]
    assert len(times) == pytest.approx(100, abs=2) and set(times) <= set(stamps)
    assert out["frames"][0] == (0, "odom", "base_link", (1.0, 2.0, 3.0), (0.0, 0.0, 0.6, 0.8))


def test_slow_odometry_and_time_that_begins_anew_are_followed():
    component, out = described()
    for stamp in (0, 100_000_000, 200_000_000, 1000, 50_000_000):
        component.on_odometry(state(stamp))
    assert [f.stamp for f in out["frames"]] == [0, 100_000_000, 200_000_000, 1000, 50_000_000]


@pytest.mark.parametrize("before", [range(5_000_000_000, 7_000_000_000, STEP), [10**18]])
def test_the_rate_holds_after_stamps_went_back(before):
    component, out = described()
    for stamp in (*before, *range(0, 2_000_000_000, STEP)):
        component.on_odometry(state(stamp))
    assert len([f for f in out["frames"] if f.stamp < 2_000_000_000]) == pytest.approx(100, abs=2)


def test_the_target_is_told_when_it_changes():
    component, out = described()
    for stamp, x in ((1, 1.0), (2, 1.0), (3, 1.5)):
        component.on_target(TargetPose(stamp, np.array([x, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]), ZERO))
    assert [(f.stamp, f.parent, f.child, f.p[0]) for f in out["frames"]] == [(1, "map", "perch_target", 1.0), (3, "map", "perch_target", 1.5)]


@pytest.mark.parametrize("changes", [{"q": (0.0,) * 4}, {"p": (nan, 0.0, 0.0)}, {"q": (nan, 0.0, 0.0, 1.0)}, {"frame": "earth"}])
def test_what_is_no_pose_is_warned_of_and_not_told(changes):
    component, out = described()
    component.on_odometry(state(0, **changes))
    assert not out["frames"] and [line.level for line in out["log"]] == ["warning"]
    if "frame" not in changes:
        component.on_target(TargetPose(0, np.array(changes.get("p", (0.0,) * 3)), np.array(changes.get("q", (0.0, 0.0, 0.0, 1.0))), ZERO))
        assert not out["frames"] and len(out["log"]) == 2


def test_an_unknown_vehicle_is_refused():
    with pytest.raises(config.ConfigError, match="zeppelin"):
        described(vehicle="zeppelin")
