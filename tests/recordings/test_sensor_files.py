"""Sensor files: imported from Kalibr and EuRoC without loss, strict, read by the nodes' components and by nothing of the simulator."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perch_core.errors import ConfigError
from perch_core.sensors import CalibrationSigmas, CameraSensor, load_sensors
from perch_core.values import CameraModel, ImuSample
from perch_core.vehicle import load_vehicle
from perch_eval.recordings import sensors_command
from perch_eval.recordings.calibration import from_asl, from_kalibr, to_yaml
from perch_perception.estimator_component import StateEstimator
from perch_perception.estimators import EstimatorConfig
from perch_perception.imu_intake import ImuIntake
from perch_perception.powerline_mapper import PowerlineMapper, PowerlineMapperConfig
from perch_perception.sensor_file import calibration_sigmas, imu_noise
from perch_perception.target_localizer import TargetLocalizer, TargetLocalizerConfig
from perch_perception.ukf.config import ImuNoise
from perch_perception.vio_component import VioComponent, VioComponentConfig
from recordings import photo_flight

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("file", sorted((ROOT / "config" / "sensors").glob("*.yaml")), ids=lambda p: p.stem)
def test_what_is_shipped_can_be_read(file):
    sensors = load_sensors(file.stem)
    assert sensors.name == file.stem and sensors.imu is not None and sensors.mounts


def test_without_a_file_the_filters_know_what_the_first_vehicles_file_says():
    assert imu_noise("snapdragon", ImuNoise(accel_noise_density=9.0)) == ImuNoise()
    for camera in ("down", "front"):
        assert calibration_sigmas("snapdragon", camera, CalibrationSigmas(focal=0.04)) == CalibrationSigmas()


def check_imu(imu, topic):
    """Each figure is in its own place."""
    assert (imu.rate, imu.topic, imu.gyro_noise_density, imu.accel_noise_density, imu.gyro_bias_walk, imu.accel_bias_walk) == (
        photo_flight.IMU_RATE, topic, photo_flight.GYRO_DENSITY, photo_flight.ACCEL_DENSITY, 1e-5, 1e-3)


def test_kalibr_says_the_same(tmp_path):
    sensors = from_kalibr(*photo_flight.kalibr(tmp_path), "mine")
    mount = sensors.mounts["cam0"]
    np.testing.assert_allclose(mount.p_BC, photo_flight.P_BC, atol=1e-9)
    np.testing.assert_allclose(mount.R_BC, photo_flight.R_BC.as_matrix(), atol=1e-7)
    assert mount.stamp_offset == pytest.approx(photo_flight.STAMP_OFFSET) and sensors.cameras["cam0"].topic == "/cam0/image_raw"
    assert sensors.imu.gyro_noise == pytest.approx(photo_flight.GYRO_DENSITY * np.sqrt(200.0))
    check_imu(sensors.imu, "/imu0")
    points = np.random.default_rng(1).uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 2.0], (50, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), photo_flight.K, photo_flight.DISTORTION)[0][:, 0]
    np.testing.assert_allclose(mount.camera.project(points)[0], expected, atol=1e-6)


def test_openvins_gives_the_inverse_transform(tmp_path):
    """Its EuRoC configuration has T_imu_cam, camera to IMU: our shipped file, made of the data set's sensor.yaml, has the same pose."""
    chain, _ = photo_flight.kalibr(tmp_path)
    rows = ([0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
            [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
            [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949], [0.0, 0.0, 0.0, 1.0])
    text = chain.read_text()
    chain.write_text("%YAML:1.0\n" + text[:text.index("  T_cam_imu")] + "  T_imu_cam:\n" + "".join(f"    - {row}\n" for row in rows)
                     + text[text.index("  cam_overlaps"):])
    mount, shipped = from_kalibr(chain, None, "mine").mounts["cam0"], load_sensors("euroc").mounts["cam0"]
    np.testing.assert_allclose(mount.p_BC, shipped.p_BC, atol=1e-9)
    np.testing.assert_allclose(mount.R_BC, shipped.R_BC, atol=1e-8)
    assert mount.stamp_offset == pytest.approx(photo_flight.STAMP_OFFSET)


def test_the_file_says_where_the_turn_on_biases_come_from(files):
    text = (files / "mine.yaml").read_text()
    assert "# accel_bias of imu, 1 sigma, is 0.2 m/s^2 by default: put the data sheet's zero-g offset there" in text and "# gyro_bias of imu" in text


def test_an_imu_that_is_mounted_turned(tmp_path):
    R_BI = Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True)
    plain, turned = (from_kalibr(*photo_flight.kalibr(tmp_path), "mine", R) for R in (np.eye(3), R_BI.as_matrix()))
    np.testing.assert_allclose(turned.mounts["cam0"].R_BC, R_BI.as_matrix() @ plain.mounts["cam0"].R_BC, atol=1e-7)
    np.testing.assert_allclose(turned.mounts["cam0"].p_BC, R_BI.apply(plain.mounts["cam0"].p_BC), atol=1e-9)
    file = tmp_path / "turned.yaml"
    file.write_text(to_yaml(turned))
    taken = []
    vio, estimator = VioComponent(VioComponentConfig(sensors=str(file), camera="cam0")), StateEstimator(EstimatorConfig(sensors=str(file)))
    for component in (vio, estimator):
        taken.append(component._intake.take(ImuSample(1, (0.1, 0.2, 0.3), (1.0, 2.0, 9.0))))
    for sample in taken:
        np.testing.assert_allclose(sample.f_B, R_BI.apply([1.0, 2.0, 9.0]), atol=1e-6)
        np.testing.assert_allclose(sample.w_B, R_BI.apply([0.1, 0.2, 0.3]), atol=1e-6)
    file.write_text(to_yaml(plain))  # its axes are those of B, whatever the driver calls its frame
    assert ImuIntake(print, str(file)).take(ImuSample(1, (0.1, 0.2, 0.3), (1.0, 2.0, 9.0), "fcu")).w_B == pytest.approx((0.1, 0.2, 0.3))
    assert ImuIntake(print).take(ImuSample(1, (0.1, 0.2, 0.3), (1.0, 2.0, 9.0))).w_B == (0.1, 0.2, 0.3)


def test_fisheye_of_kalibr(tmp_path):
    chain, _ = photo_flight.kalibr(tmp_path)
    k = [-0.01, 0.02, -0.015, 0.004]
    chain.write_text(chain.read_text().replace("radtan", "equidistant").replace(str(photo_flight.DISTORTION.tolist()), str(k)))
    camera = from_kalibr(chain, None, "fisheye").mounts["cam0"].camera
    points = np.random.default_rng(2).uniform([-1.5, -1.5, 0.8], [1.5, 1.5, 1.5], (50, 3))
    expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), photo_flight.K, np.array(k))[0][:, 0]
    np.testing.assert_allclose(camera.project(points)[0], expected, atol=1e-6)


def test_euroc_says_the_same(files):
    sensors = from_asl(files / "asl" / "mav0")
    np.testing.assert_allclose(sensors.mounts["cam0"].R_BC, photo_flight.R_BC.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(sensors.mounts["cam0"].p_BC, photo_flight.P_BC, atol=1e-9)
    assert sensors.cameras["cam0"].rate == photo_flight.IMAGE_RATE
    assert sensors.mounts["cam0"].camera == load_sensors(files / "mine.yaml").mounts["cam0"].camera, "as by Kalibr"
    check_imu(sensors.imu, "")


def test_the_body_of_euroc_is_the_imu_wherever_it_is_in_that_of_the_data_set(files, tmp_path):
    """`T_BS` of the camera is in the data set's body, which may be another one than the IMU."""
    T, plain = np.eye(4), from_asl(files / "asl" / "mav0")
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", [100.0, 20.0, -40.0], degrees=True).as_matrix(), (0.07, -0.03, -0.12)
    for name in ("imu0", "cam0"):
        file = tmp_path / "mav0" / name / "sensor.yaml"
        file.parent.mkdir(parents=True)
        text = (files / "asl" / "mav0" / name / "sensor.yaml").read_text()
        there = T @ (np.eye(4) if name == "imu0" else np.block([[photo_flight.R_BC.as_matrix(), photo_flight.P_BC[:, None]], [np.eye(4)[3:]]]))
        file.write_text(re.sub(r"data: \[.*\]", lambda _: f"data: {there.ravel().tolist()}", text, count=1))
    moved = from_asl(tmp_path / "mav0")
    np.testing.assert_allclose(moved.mounts["cam0"].R_BC, plain.mounts["cam0"].R_BC, atol=1e-9)
    np.testing.assert_allclose(moved.mounts["cam0"].p_BC, plain.mounts["cam0"].p_BC, atol=1e-9)


def test_what_is_written_can_be_read_again(files, tmp_path):
    for sensors in (load_sensors(files / "mine.yaml"), load_sensors("snapdragon"), load_sensors("euroc")):
        file = tmp_path / "again.yaml"
        file.write_text(to_yaml(sensors, "a comment"))
        assert load_sensors(file) == sensors


def test_the_command(files, tmp_path, capsys):
    out = tmp_path / "named.yaml"
    assert sensors_command.main(["import", "euroc", str(files / "asl"), "--rename", "cam0=down", "--name", "mine", "--out", str(out)]) == 0
    assert list(load_sensors(out).cameras) == ["down"] and load_sensors(out).name == "mine"
    capsys.readouterr()
    for arguments, words in ((["euroc", str(files)], "mav0"), (["kalibr", str(files / "mine.yaml")], "no cam0"),
                             (["kalibr", str(tmp_path / "none.yaml")], "cannot be read"),
                             (["euroc", str(files / "asl"), "--rename", "left=down"], "--rename"),
                             (["euroc", str(files / "asl"), "--rename", "cam0=down", "cam0=front"], "two to one"),
                             (["euroc", str(files / "asl"), "--imu-orientation", "0", "0", "0", "0"], "--imu-orientation")):
        assert sensors_command.main(["import", *arguments]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and words in said[0], said


def test_two_cameras_do_not_get_one_name():
    args = sensors_command.parser().parse_args(["import", "kalibr", "chain.yaml", "--rename", "down=one", "front=one"])
    with pytest.raises(ConfigError, match="one name to two cameras"):
        sensors_command._renamed(load_sensors("snapdragon"), args)


@pytest.mark.parametrize("old, new, words", [
    ("camera_model: pinhole", "camera_model: omni", "camera_model"),
    ("distortion_model: radtan", "distortion_model: fov", "distortion_model"),
    ("resolution: [512, 384]", "resolution: [512]", "resolution"), ("T_cam_imu", "T_other", "T_cam_imu"),
    ("timeshift_cam_imu: -0.005", "timeshift_cam_imu: late", "timeshift_cam_imu"),
    ("timeshift_cam_imu: -0.005", "timeshift_cam_imu: 5.0", "timeshift_cam_imu: 5 s is outside"), ("[300.0,", "[-300.0,", "focal"),
    ("[300.0,", "[1.0,", "cam0.focal: focal lengths of 1 and 301 px for 512 x 384 px"),
    ("0.000000000000000, 1.000000000000000]", "0.000000000000000, 2.000000000000000]", "rigid")])
def test_calibrations_that_are_none_are_refused(tmp_path, old, new, words):
    chain, _ = photo_flight.kalibr(tmp_path)
    assert old in chain.read_text()
    chain.write_text(chain.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=words):
        from_kalibr(chain, None, "mine")


@pytest.mark.parametrize("name, entry, diagonal", [  # as Kalibr and OpenVINS write them
    ("gyroscopes.M", "gyroscopes:\n  M: {0}", 1.0), ("gyroscopes.A", "gyroscopes:\n  A: {0}", 0.0),
    ("gyroscopes.C_gyro_i", "gyroscopes:\n  C_gyro_i: {0}", 1.0), ("accelerometers.M", "accelerometers:\n  M: {0}", 1.0),
    ("Tw", "Tw: {0}", 1.0), ("Ta", "Ta: {0}", 1.0), ("Tg", "Tg: {0}", 0.0), ("R_IMUtoGYRO", "R_IMUtoGYRO: {0}", 1.0)])
def test_an_imu_whose_samples_need_a_correction_is_refused(tmp_path, name, entry, diagonal):
    chain, imu = photo_flight.kalibr(tmp_path)
    plain, matrix = imu.read_text(), diagonal * np.eye(3)
    imu.write_text(plain + entry.format(matrix.tolist()) + "\n")
    assert from_kalibr(chain, imu, "mine").imu is not None
    matrix[1, 0] = 0.012
    for value in (matrix.tolist(), "[[1.0, 0.0]]"):
        imu.write_text(plain + entry.format(value) + "\n")
        with pytest.raises(ConfigError, match=f"{name}: .* is not .*sensor files have no scale"):
            from_kalibr(chain, imu, "mine")


def test_components_take_everything_from_the_file(files):
    name, sensors = str(files / "mine.yaml"), load_sensors(files / "mine.yaml")
    vio = VioComponent(VioComponentConfig(sensors=name, camera="cam0"))
    assert vio.config.imu.accel_noise_density == sensors.imu.accel_noise_density and vio.config.imu.integration == "instant"
    assert vio.config.calibration.time_offset == sensors.cameras["cam0"].sigma.time_offset
    target = TargetLocalizer(TargetLocalizerConfig(sensors=name, camera="cam0"))
    assert target.mounted.nominal.camera == sensors.mounts["cam0"].camera
    assert target.config.calibration.rotation == pytest.approx(sensors.cameras["cam0"].sigma.rotation)
    config = PowerlineMapperConfig(sensors=name, camera="cam0")
    wires = PowerlineMapper(replace(config, detection=replace(config.detection, appearance="plain")))
    assert wires.config.mapper.triangulation.mount_rotation == pytest.approx(sensors.cameras["cam0"].sigma.rotation)
    with pytest.raises(ConfigError, match="'down' of .* is not there; usable: cam0"):
        VioComponent(VioComponentConfig(sensors=name))
    with pytest.raises(ConfigError, match="no such file"):
        StateEstimator(EstimatorConfig(sensors=str(files / "none.yaml")))


def test_a_file_of_the_imu_alone_leaves_the_cameras_to_the_vehicle(tmp_path):
    file, camera = tmp_path / "imu.yaml", load_vehicle("rpg").mounts["down"].camera
    file.write_text("{name: imu, imu: {rate: 200.0, accel_noise_density: 0.02, gyro_noise_density: 0.002, accel_bias_walk: 0.001, gyro_bias_walk: 1.0e-4}}")
    vio = VioComponent(VioComponentConfig(sensors=str(file), vehicle="rpg"))
    assert vio.config.imu.gyro_noise_density == 0.002 == StateEstimator(EstimatorConfig(sensors=str(file))).config.imu.gyro_noise_density
    assert vio.mounted.nominal.camera == camera and vio.mounted.mount is None and vio.config.calibration == VioComponentConfig().calibration
    vio.on_camera_info(CameraModel(1, "camera_down_optical_frame", replace(camera, fx=280.0)))
    assert vio.mounted.known.camera.fx == 280.0


def test_a_lens_without_distortion_has_none():
    common = dict(width=640, height=480, focal=(500.0, 500.0), centre=(320.0, 240.0))
    with pytest.raises(ConfigError, match="radtan"):
        CameraSensor(model="pinhole", distortion=(0.1, 0.0, 0.0, 0.0), **common)
    with pytest.raises(ConfigError, match="distortion"):
        CameraSensor(model="equidistant", distortion=(0.1, 0.0), **common)


def test_the_simulator_does_not_read_them():
    sources = list((ROOT / "src" / "perch_sim").rglob("*.py"))
    assert len(sources) > 20 and not [p for p in sources if "perch_core.sensors" in p.read_text() or "load_sensors" in p.read_text()]
