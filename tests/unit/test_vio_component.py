"""VIO as a component: rendered images through its ports, with every lens and IMU rate, and the faults of its inputs."""

import functools
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import RadialTangentialCamera
from perch_core.config import from_mapping
from perch_core.values import CameraImage, CameraModel, ImuSample, InertialState, OdometryState, Transform
from perch_core.vehicle import load_vehicle
from open_loop.flight import motion_of
from open_loop.motion import read_imu
from perch_perception import vio_component
from perch_perception.estimator_component import StateEstimator
from perch_perception.ukf import UkfConfig
from perch_perception.vio_component import VioComponent, VioComponentConfig
from perch_sim.rendering import Renderer, build_scene
from perch_sim.scenario import load_scenario

from unit.component_outputs import Outputs

SCENARIO = load_scenario("surface_90")
VEHICLE = load_vehicle("snapdragon")
DOWN = VEHICLE.mounts["down"]
FRAME = "camera_down_optical_frame"
LENSES = {
    "equidistant": DOWN.camera,
    "plumb_bob": RadialTangentialCamera(640, 480, 300.0, 301.0, 318.0, 242.0, (-0.12, 0.012, 4e-4, -3e-4, 0.0)),
    "rational_polynomial": RadialTangentialCamera(640, 480, 300.0, 300.0, 321.0, 239.0, (0.4, 0.1, 2e-4, -1e-4, 0.01, 0.6, 0.2, 0.02)),
}
END = 4.0  # up, and a hover [s]


@functools.lru_cache(maxsize=4)
def frames(lens):
    """(stamp [ns], image) of the down camera."""
    mount = replace(DOWN, camera=LENSES[lens])
    renderer, motion = Renderer(build_scene(SCENARIO, 3), mount, 3), motion_of(SCENARIO, 3)
    out = []
    for middle in np.arange(0.05, END - 0.02, 1 / 30):
        pose = motion.sample(np.array([middle]))
        image = renderer.render([(pose.p_WB[0], pose.R_WB[0])], np.random.default_rng(round(middle * 1e6)))
        out.append((round((middle + mount.stamp_offset) * 1e9), image))
    return out


def nobody():
    """Whether somebody looks."""
    return False


class Flight:
    """A climb and a hover as the component gets it; debug images are drawn where the flight is `watched`."""

    def __init__(self, lens="equidistant", rate=500.0, told=None, watched=False, **parameters):
        self.component = VioComponent(from_mapping(VioComponentConfig, {"start_yaw_deg": 0.0, **parameters}, "vio"))
        if not watched:
            self.component.debug_image.receiver_check = nobody
        self.out, self.lens, self.told = Outputs(self.component), lens, LENSES[told or lens]
        self.motion = motion_of(SCENARIO, 3)
        self.times = np.arange(0.0, END, 1.0 / rate)
        truth = self.motion.sample(self.times)
        noise = math.sqrt(rate / 500.0)  # the same density
        imu = replace(VEHICLE.imu, accel_noise=VEHICLE.imu.accel_noise * noise, gyro_noise=VEHICLE.imu.gyro_noise * noise)
        readings = read_imu(truth, imu, np.random.default_rng(5))
        self.samples = [ImuSample(round(t * 1e9), tuple(w), tuple(f))
                        for t, w, f in zip(self.times, readings.gyro.tolist(), readings.accel.tolist())]
        self.waiting = list(frames(lens))

    def fly(self, until=END, shift=0, tamper=lambda image: image):
        """IMU and images in the order of their arrival, 20 ms after the exposure, stamps shifted by `shift` [ns]."""
        while self.samples and self.samples[0].stamp < until * 1e9:
            sample = self.samples.pop(0)
            self.component.on_imu(sample._replace(stamp=sample.stamp + shift))
            while self.waiting and self.waiting[0][0] + 28_000_000 <= sample.stamp:
                stamp, pixels = self.waiting.pop(0)
                self.component.on_camera_info(CameraModel(stamp + shift, FRAME, self.told))
                self.component.on_image(tamper(CameraImage(stamp + shift, FRAME, 640, 480, "mono8", pixels)))
        return self

    def error(self, state, shift=0):
        truth = self.motion.sample(np.array([(state.stamp - shift) * 1e-9]))
        turn = so3.log(truth.R_WB[0] @ so3.quat_to_matrix(state.q_WB).T)
        return np.linalg.norm(state.p_WB - truth.p_WB[0]), np.linalg.norm(state.v_WB - truth.v_WB[0]), np.linalg.norm(turn)


@functools.cache
def climbed(lens="equidistant", rate=500.0):
    """After the whole flight."""
    return Flight(lens, rate).fly()


@functools.cache
def _climbing():
    return pickle.dumps(Flight().fly(2.5))


def climbing():
    """After 2.5 s, in flight: a copy of its own, of one flight."""
    return pickle.loads(_climbing())


@pytest.mark.parametrize(("lens", "rate"), [("equidistant", 500.0), ("plumb_bob", 1000.0), ("rational_polynomial", 100.0)])
def test_a_climb_with_every_lens_and_imu_rate(lens, rate):
    flight = climbed(lens, rate)
    states = flight.out["state"]
    assert len(states) > 100 and isinstance(states[-1], InertialState)
    p, v, turn = flight.error(states[-1])
    assert p < 0.06 and v < 0.06 and turn < 0.02
    assert "outcome" in flight.out["diagnostics"][-1].values and flight.out["diagnostics"][-1].values["outcome"] == "TRACKING"
    for state, odometry in zip(states, flight.out["odometry"], strict=True):
        assert state.stamp == odometry.stamp and state.p_WB.tolist() == list(odometry.p_WB) and odometry.frame == "odom"
    np.testing.assert_allclose(odometry.v_WB, state.v_WB, atol=1e-12)
    assert not any("gap" in text for text in flight.out.warnings())


def test_the_wrong_lens_is_not_the_same():
    """The intrinsics are those of camera_info: told another lens, VIO is wrong."""
    off = [max(flight.error(s)[0] for s in flight.out["state"] if s.stamp < 3e9) for flight in (climbed(), Flight(told="plumb_bob").fly(3.0))]
    assert off[1] > 0.05 > 2 * off[0]


def test_images_wait_for_camera_info_and_the_imu():
    flight = Flight()
    stamp, pixels = flight.waiting[0]
    image = CameraImage(stamp, FRAME, 640, 480, "mono8", pixels)
    flight.component.on_image(image)
    assert flight.out["state"] == [] and any("camera_info" in text for text in flight.out.warnings())
    flight.component.on_camera_info(CameraModel(stamp, FRAME, DOWN.camera))
    for sample in flight.samples[:600]:
        if sample.stamp < stamp + 8_000_000:
            flight.component.on_imu(sample)
    assert flight.out["diagnostics"] == []
    for sample in flight.samples[:600]:
        if sample.stamp >= stamp + 8_000_000:
            flight.component.on_imu(sample)
    assert len(flight.out["diagnostics"]) == 1


def test_a_vehicle_on_legs_starts_as_high_as_its_file_says(tmp_path, monkeypatch):
    legs, given = tmp_path / "legs.yaml", []
    legs.write_text("extends: snapdragon\nground_offset: 0.12\n")
    monkeypatch.setattr(vio_component, "VisualInertialOdometry", lambda config, mount, standing, yaw, floor: given.extend((*standing, floor)))
    VioComponent(VioComponentConfig(vehicle=str(legs), start_position=(1.0, 2.0, 0.5)))
    assert given == pytest.approx([1.0, 2.0, 0.62, 0.5])


def test_a_missing_imu_is_named():
    component = VioComponent(VioComponentConfig())
    out = Outputs(component)
    component.on_camera_info(CameraModel(0, FRAME, DOWN.camera))
    for k in range(11):
        component.on_image(CameraImage(33_000_000 * k, FRAME, 640, 480, "mono8", np.zeros((480, 640), np.uint8)))
    assert any("images are waiting (no imu/data_raw yet)" in text for text in out.warnings())
    component.on_imu(ImuSample(0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
    assert component.missing == ""


def test_a_camera_without_images_is_named():
    component = VioComponent(VioComponentConfig())
    out = Outputs(component)
    for k in range(201):
        assert out["diagnostics"] == []
        component.on_imu(ImuSample(10_000_000 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
    last = out["diagnostics"][-1]
    assert (last.level, last.message) == (1, "camera_down/image_raw: no image for 2 s") and last.message in out.warnings()


@pytest.mark.parametrize("change", [dict(encoding="mono16"), dict(width=320), dict(pixels=np.zeros((480, 640), np.float32)),
                                    dict(pixels=lambda region: None)])
def test_an_image_of_another_kind_is_refused(change):
    def tamper(image):
        fields = dict(stamp=image.stamp, frame=FRAME, width=640, height=480, encoding="mono8", pixels=image.pixels())
        return CameraImage(**{**fields, **change})

    flight = Flight().fly(0.6)
    count = len(flight.out["state"])
    flight.fly(0.8, tamper=tamper)
    assert len(flight.out["state"]) == count
    assert any("bad_image" in text for text in flight.out.warnings())
    assert len(flight.fly(1.0).out["state"]) > count


def test_colour_images_are_used_in_grey():
    def tamper(image):
        return CameraImage(image.stamp, FRAME, 640, 480, "bgr8", np.repeat(image.pixels()[..., None], 3, axis=2))

    grey, colour = ([s.p_WB.tolist() for s in flight.out["state"]] for flight in (climbed(), Flight().fly(1.5, tamper=tamper)))
    assert len(colour) > 25 and grey[:len(colour)] == colour


@pytest.mark.parametrize("shift", [-3600 * 10**9, 3600 * 10**9])
def test_a_vehicle_that_was_started_again_is_followed(shift):
    """Stamps go on from elsewhere: VIO begins anew, on the ground where it was told to start."""
    shift += 10**13
    flight = Flight().fly(1.0, shift=10**13)
    again = Flight()
    again.component, again.out = flight.component, flight.out
    again.fly(2.5, shift=shift)
    assert any("restarting" in text for text in flight.out.warnings())
    last = flight.out["state"][-1]
    assert last.stamp > shift and again.error(last, shift)[0] < 0.05


def test_stamps_that_jump_ahead_in_flight_leave_position_and_heading_unknown():
    """Also where no sample after a first jump can be used."""
    flight = climbing()
    for jump, gyro in ((3, (math.nan,) * 3), (6, (0.0,) * 3)):
        for sample in flight.samples[:12]:
            flight.component.on_imu(sample._replace(stamp=sample.stamp + jump * 10**9, w_B=gyro))
    known = flight.component._vio._last_pose.present()
    assert known.covariance[0, 0] > 100.0**2 and known.covariance[3, 3] > 1.0
    assert any("position and heading are unknown" in text for text in flight.out.warnings())


@pytest.mark.parametrize(("step", "again"), [(30, 0), (100, 0), (0, 10), (0, 50)])
def test_a_clock_that_is_set_back_a_little_and_samples_delivered_again_discard_nothing(step, again):
    """In flight. A step of 100 ms hides so much motion that vision may no longer fit: then VIO goes on from its last pose."""
    flight = climbing()
    before = flight.out["state"][-1].stamp
    for k in range(again):
        flight.component.on_imu(flight.samples[0]._replace(stamp=flight.samples[0].stamp - 2_000_000 * (again + 5 - k)))
    flight.fly(shift=-1_000_000 * step)
    states, last = flight.out["state"], flight.out["state"][-1]
    assert not any("restarting" in text for text in flight.out.warnings())
    assert flight.out["diagnostics"][-1].values["restarts"] <= (step == 100)
    assert last.stamp > before + 1e9 and all(s.stamp < t.stamp for s, t in zip(states, states[1:]))
    assert flight.error(last, -1_000_000 * step)[0] < 0.08


def test_an_image_that_is_repeated_in_flight_is_no_rest():
    """The camera freezes in the climb: no pose from then on, and poses again with the images."""
    flight, held = Flight().fly(2.0), []

    def freeze(image):
        held.append(image.pixels())
        return CameraImage(image.stamp, FRAME, 640, 480, "mono8", held[0])

    flight.fly(3.2, tamper=freeze)
    assert flight.component.result.outcome.name == "REPEATED" and flight.out["state"][-1].stamp < 2.1e9
    flight.fly()
    last = flight.out["state"][-1]
    assert flight.component.result.outcome.name == "TRACKING" and flight.error(last)[0] < 3.0 * math.sqrt(np.trace(last.covariance[:3, :3]))


def test_bad_samples_are_dropped_with_a_warning():
    flight = Flight().fly(1.0)
    last = flight.samples[0].stamp
    for bad in (ImuSample(last, (math.nan,) * 3, (0.0, 0.0, 9.81)), ImuSample(last - 10**8, (0.0,) * 3, (0.0, 0.0, 9.81)),
                ImuSample(10**18, (0.0,) * 3, (0.0, 0.0, 9.81)), ImuSample(last + 1, (0.0,) * 3, (0.0, 0.0, 9.81), "somewhere")):
        flight.component.on_imu(bad)
    for words in ("w_B: nan is not finite", f"stamp {last - 10**8} ns does not follow", f"stamp {10**18} ns does not follow", "frame 'somewhere'"):
        assert any(text.startswith("imu/data_raw: ") and words in text for text in flight.out.warnings()), words
    state = flight.fly(2.5).out["state"][-1]
    assert flight.error(state)[0] < 0.05


def test_extrinsics_by_transforms():
    flight = Flight(extrinsics="tf")
    flight.fly(0.3)
    assert flight.out["state"] == []
    flight.component.on_transform(Transform("base_link", FRAME, tuple(DOWN.p_BC.tolist()), tuple(so3.quat_from_matrix(DOWN.R_BC).tolist())))
    assert flight.fly(2.0).error(flight.out["state"][-1])[0] < 0.05


def test_the_debug_image_is_drawn_for_those_who_look():
    image = Flight(watched=True).fly(0.3).out["debug_image"][-1]
    assert (image.encoding, image.pixels().shape) == ("bgr8", (480, 640, 3))
    assert Flight().fly(0.3).out["debug_image"] == []


def test_vio_and_estimator_together_at_200_hz():
    """State by state: the estimator is where VIO is, at the rate of the IMU."""
    flight, estimator = Flight(rate=200.0), StateEstimator(UkfConfig())
    out = Outputs(estimator)
    flight.component.state.receivers.append(estimator.on_vio_state)
    flight.component.odometry.receivers.append(estimator.on_vio_odometry)
    take = flight.component.on_imu
    flight.component.on_imu = lambda sample: (take(sample), estimator.on_imu(sample))
    flight.fly()
    last = out["odometry"][-1]
    truth = flight.motion.sample(np.array([last.stamp * 1e-9]))
    assert np.linalg.norm(np.array(last.p_WB) - truth.p_WB[0]) < 0.06
    assert np.diff([o.stamp for o in out["odometry"]]).tolist() == [5_000_000] * (len(out["odometry"]) - 1)
    assert out["status"][-1].state == 1


TURN, SHIFT = so3.exp(np.array([0.0, 0.0, 0.7])), np.array([5.0, -3.0, 20.0])
POSE_SIGMA = np.array([0.3, 0.2, 0.1, 0.01, 0.01, 0.05])


def elsewhere(stamp, p_WB, v_WB, R_WB):
    """Odometry of an estimator for which the vehicle is at another place, with another heading."""
    q = tuple(so3.quat_from_matrix(TURN @ R_WB))
    return OdometryState(stamp, tuple(TURN @ p_WB + SHIFT), q, tuple(R_WB.T @ v_WB), (0.0, 0.0, 0.0),
                         np.diag(POSE_SIGMA**2), 0.01 * np.eye(6), "map")


def joined(begin, until, tamper=lambda flight, odometry: odometry):
    """A VIO that is started at a time of the flight; `tamper` changes the odometry."""
    flight = Flight()
    flight.samples = [sample for sample in flight.samples if sample.stamp >= begin * 1e9]
    flight.waiting = [frame for frame in flight.waiting if frame[0] >= begin * 1e9]
    stamps = [sample.stamp for sample in flight.samples if sample.stamp < until * 1e9]
    truth = flight.motion.sample(np.array(stamps) * 1e-9)
    for stamp, *moved in zip(stamps, truth.p_WB, truth.v_WB, truth.R_WB):
        odometry = elsewhere(stamp, *moved)
        flight.component.on_estimate(tamper(flight, odometry))
        flight.fly((stamp + 1) * 1e-9)
    return flight


@pytest.mark.parametrize("begin", [1.0, 2.0])
def test_started_late_it_continues_the_odometry_and_ignores_it_from_then_on(begin):
    """On the floor, and in the climb."""
    flight = joined(begin, 3.4, lambda flight, odometry: odometry._replace(p_WB=(9e2, 9e2, 9e2)) if flight.out["state"] else odometry)
    assert len(flight.out["state"]) > 8
    for state in flight.out["state"]:
        truth = flight.motion.sample(np.array([state.stamp * 1e-9]))
        assert np.linalg.norm(state.p_WB - TURN @ truth.p_WB[0] - SHIFT) < 0.06
        assert np.linalg.norm(so3.log((TURN @ truth.R_WB[0]).T @ so3.quat_to_matrix(state.q_WB))) < 0.03
    sigma = np.sqrt(np.diag(flight.out["odometry"][0].pose_covariance))
    np.testing.assert_allclose(sigma[[0, 1, 2, 5]], POSE_SIGMA[[0, 1, 2, 5]], rtol=0.1)


@pytest.mark.parametrize("change", [dict(frame="camera_link"), dict(pose_covariance=-np.eye(6)), dict(stamp=10)])
def test_odometry_that_cannot_be_used_leaves_the_configured_start(change):
    flight = joined(1.0, 1.4, lambda flight, odometry: odometry._replace(**change))
    assert flight.error(flight.out["state"][-1])[0] < 0.05
