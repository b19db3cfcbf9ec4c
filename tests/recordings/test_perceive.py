"""`scripts/perceive.py` on a photographed floor: what it finds is where it is, and what it cannot read is refused in a line."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from perch_core.sensors import load_sensors
from perch_core.values import CameraImage, ImuSample, OdometryState
from perch_eval.flight import timed
from perch_eval.recordings import check, command
from perch_eval.recordings.command import _unused
from perch_eval.recordings.opening import BagRecording, _topic
from perch_eval.recordings.perception import Perception
from perch_eval.recordings.recording import AslRecording, RecordingError
from perch_eval.recordings.trajectory import read_trajectory, read_truth
from recordings import photo_flight
from unit.recorded_flights import flown, record


def perceive(*arguments) -> int:
    return command.main([str(a) for a in arguments])


def report(folder) -> dict:
    return json.loads((folder / "report.json").read_text())


@pytest.fixture(scope="module")
def euroc(files, tmp_path_factory):
    """What comes of a folder in which three images cannot be read; wires are looked for twice a second."""
    folder = tmp_path_factory.mktemp("euroc")
    shutil.copytree(files / "asl", folder / "asl")
    for path in sorted((folder / "asl" / "mav0" / "cam0" / "data").iterdir())[70:73]:
        path.write_bytes(path.read_bytes()[:100])
    assert perceive(folder / "asl", "--out", folder, "-p", "powerline_mapper.rate:=2.0") == 0
    return folder


@pytest.fixture
def few_looks(undrawn, monkeypatch):
    """The page is that of `euroc`, the checks of the sensors are those of `test_checks.py`."""
    monkeypatch.setattr(check, "SAMPLED_IMAGES", 12)
    monkeypatch.setattr(check, "SPAN", 4.0)


def test_the_motion_is_found(euroc):
    found = report(euroc)
    assert found["restarts"] == 0 and found["frames"]["TRACKING"] > 60
    assert found["frames"]["BAD_IMAGE"] == 3  # a frame that cannot be read costs a frame
    for who in ("vio", "estimator"):  # 2 m of path; the truth is of the file beside the images
        assert found[who]["ate_rmse_m"] < 0.015 and 1.2 < found[who]["path_m"] < 4.0
        assert found[who]["attitude_rms_deg"] < 1.5
    assert found["vio"]["nees_position_mean"] < 9.0 and abs(found["vio"]["scale"] - 1.0) < 0.02


def test_the_board_is_where_it_lies_and_there_is_no_wire(euroc, flight):
    found = report(euroc)
    assert found["target"]["found"] > 60 and found["target"]["spread_m"] < 0.02 and found["powerlines"] == 0
    start = np.loadtxt(euroc / "vio.tum")[0]
    heading = (Rotation.from_quat(start[4:]) * Rotation.from_quat(flight.q_WB[0]).inv()).as_euler("zyx")[0]  # VIO's against the truth's
    pad = Rotation.from_euler("z", heading).apply(np.array([*photo_flight.PAD, 0.0]) - flight.p_WB[0])
    seen = np.loadtxt(euroc / "target.tum")[:, 1:4] - start[1:4]
    assert np.linalg.norm(np.median(seen, axis=0) - pad) < 0.02


def test_biases_within_what_is_declared_are_no_warning(euroc):
    levels = {f["about"]: f["level"] for f in report(euroc)["findings"]}
    assert levels["accel bias of VIO"] == levels["gyro bias of VIO"] == "ok"


def test_an_accelerometers_bias_beyond_the_sensor_file_is_to_be_declared_and_a_truth_on_another_clock_is_not_compared(few_looks, files, tmp_path, capsys):
    """0.1 m/s^2 along gravity, where 0.01 is declared."""
    (tmp_path / "far.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    mine = yaml.safe_load((files / "mine.yaml").read_text())
    mine["imu"]["accel_bias"] = 0.01
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mine))
    assert perceive(files / "mcap", "--sensors", tmp_path / "mine.yaml", "--truth", tmp_path / "far.tum", "--out", tmp_path,
                    "--without", "target_localizer", "powerline_mapper") == 0
    assert "warning: accel bias of VIO: " in (said := capsys.readouterr().out) and "declare accel_bias in the sensor file" in said
    assert "not compared: the truth" in said and "path_m" in report(tmp_path)["vio"]


def test_the_page_shows_it(euroc):
    page = (euroc / "report.html").read_text()
    names = ("The path", "Error and covariance", "Biases", "Tracks", "The board", "Wires", "The sensors")
    assert all(f"<h2>{name}</h2>" in page for name in names) and page.count("data:image/") > 12


def test_a_bag_that_broke_off_is_read_as_far_as_it_goes_with_its_truth_on_a_topic(few_looks, files, tmp_path, capsys):
    """Nothing is damaged in the whole one: `test_checks.py`."""
    whole = next((files / "mcap").glob("*.mcap")).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[:3 * len(whole) // 4])
    assert perceive(cut, "--sensors", files / "mine.yaml", "--truth", "/truth", "--out", tmp_path / "out",
                    "--without", "target_localizer", "powerline_mapper") == 0
    assert "damage:" in capsys.readouterr().out
    seen, everything = report(tmp_path / "out"), BagRecording(files / "mcap", None)
    assert seen["damage"] and 0.6 < seen["imu_samples"] / everything.samples < 0.9
    assert seen["vio"]["ate_rmse_m"] < 0.015 and seen["vio"]["path_m"] > 0.5
    vio, true = read_trajectory(tmp_path / "out" / "vio.tum"), read_trajectory(tmp_path / "out" / "truth.tum")
    assert true.stamps[0] == photo_flight.START and len(vio) > 50  # to the nanosecond


def test_the_truth_that_the_simulator_records_beside_the_imu_is_used(files):
    """It is that of the body: an IMU that is mounted turned has its axes turned in it."""
    sensors = load_sensors(files / "mine.yaml")
    recording = BagRecording(files / "mcap", replace(sensors, imu=replace(sensors.imu, orientation=(1.0, 0.0, 0.0, 0.0))))
    assert read_truth(recording, None) is None
    recording.truth_topic = "/truth"  # in place of ground_truth/odometry
    body, imu = read_truth(recording, "/truth"), read_truth(recording, None)
    np.testing.assert_allclose(Rotation.from_quat(imu.q[:9]).as_matrix(), Rotation.from_quat(body.q[:9]).as_matrix() @ np.diag([1.0, -1.0, -1.0]), atol=1e-9)
    np.testing.assert_array_equal(imu.p, body.p)


def test_the_truth_of_a_recording_of_perch_is_found(tmp_path):
    record(tmp_path / "flight.mcap", {**flown(), "imu/data_raw": timed(ImuSample(k * 2_000_000, np.zeros(3), np.zeros(3)) for k in range(9))})
    assert BagRecording(tmp_path / "flight.mcap", None).truth_topic == "/ground_truth/odometry"


def test_a_bag_without_images_and_imu_is_refused(tmp_path):
    record(tmp_path / "flight.mcap", {"ground_truth/odometry": flown()["ground_truth/odometry"]})
    with pytest.raises(RecordingError, match="neither images nor samples of an IMU .*; its topics: .*ground_truth/odometry"):
        BagRecording(tmp_path / "flight.mcap", None)


def test_topics_that_the_recording_lacks_are_those_of_the_nodes(files):
    """A calibration names those of its own recording; drivers are remapped for the nodes."""
    available = {"/imu/data_raw", "/quad1/camera_down/image_raw/compressed", "/imu0"}
    assert _topic(("/imu0", "imu/data_raw"), available) == "/imu0" and _topic(("/imu1", "imu/data_raw"), available) == "/imu/data_raw"
    assert _topic(("/cam0/image_raw", "camera_down/image_raw"), available) == "/quad1/camera_down/image_raw/compressed"
    sensors = load_sensors(files / "mine.yaml")
    for other, words in ((replace(sensors, cameras={"x": replace(sensors.cameras["cam0"], topic="/x")}), r"`topic`, or camera_<name>/image_raw"),
                         (replace(sensors, imu=replace(sensors.imu, topic="/x")), r"no IMU on /x \(`topic` of the IMU")):
        with pytest.raises(RecordingError, match=words):
            BagRecording(files / "mcap", other)


def test_truth_of_markers_is_taken_to_the_imu(files, tmp_path):
    """As `vicon0` of EuRoC: poses of the markers, and in `sensor.yaml` where they are on the body."""
    recording = AslRecording(files / "asl", None)
    imu, source = read_truth(recording, None), recording.truth.parent
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", [100.0, 20.0, -40.0], degrees=True).as_matrix(), (0.07, -0.03, -0.12)
    markers = imu.turned(Rotation.from_matrix(T[:3, :3]).as_quat(), T[:3, 3])
    shutil.copytree(files / "asl", tmp_path / "asl")
    shutil.rmtree(tmp_path / "asl" / source.relative_to(files / "asl"))
    folder = tmp_path / "asl" / "mav0" / "vicon0"
    folder.mkdir()
    rows = [f"{s},{','.join(map(str, p))},{q[3]},{q[0]},{q[1]},{q[2]}" for s, p, q in zip(markers.stamps, markers.p, markers.q)]
    (folder / "data.csv").write_text("\n".join(rows))
    (folder / "sensor.yaml").write_text(f"T_BS: {{rows: 4, cols: 4, data: {T.ravel().tolist()}}}\n")
    again = read_truth(AslRecording(tmp_path / "asl", None), None)
    np.testing.assert_allclose(again.p, imu.p, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(again.q * imu.q, axis=1)), 1.0, atol=1e-9)


def test_a_folder_of_images(flight, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), flight.images[5])
    (folder / "b.jpg").write_bytes(b"not an image")
    (folder / "notes.txt").write_text("neither")
    assert perceive(folder, "--out", tmp_path / "out") == 0
    seen = json.loads((tmp_path / "out" / "detections.json").read_text())
    assert list(seen) == ["a.png"] and "b.jpg" in str(report(tmp_path / "out")["problems"])
    tags = {tag["id"]: np.array(tag["corners"]) for tag in seen["a.png"]["tags"]}
    assert set(tags) == {0, 1, 2, 3}
    for number, centre in enumerate(((0.2, 0.2), (0.2, -0.2), (-0.2, -0.2), (-0.2, 0.2))):  # by OpenCV's projection
        corners = photo_flight.PAD + centre + 0.08 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
        p_WB, R_WB = photo_flight.Motion(6.0).pose(0.02 + 5 / photo_flight.IMAGE_RATE)
        R_CW = (R_WB * photo_flight.R_BC).inv()
        turn, place = R_CW.as_rotvec(), -R_CW.apply(p_WB + R_WB.apply(photo_flight.P_BC))
        pixels = cv2.projectPoints(np.column_stack([corners, np.zeros(4)]), turn, place, photo_flight.K, photo_flight.DISTORTION)[0][:, 0]
        assert np.abs(tags[number] - pixels).max() < 1.0


def test_parameters_apply_to_images_or_are_refused(flight, files, tmp_path, capsys):
    floor, wire, out = tmp_path / "floor.png", tmp_path / "wire.png", tmp_path / "out"
    cv2.imwrite(str(floor), flight.images[5])
    drawn = np.full((240, 320, 3), 120, np.uint8)
    cv2.line(drawn, (100, 100), (160, 110), (60, 60, 180), 3, cv2.LINE_AA)  # too short for one without a colour
    cv2.imwrite(str(wire), drawn)

    def detections(image, *arguments):
        assert perceive(image, "--out", out, *arguments) == 0
        return json.loads((out / "detections.json").read_text())[image.name]

    calibrated = ("--sensors", files / "mine.yaml")
    assert "board" in detections(floor, *calibrated)
    near = detections(floor, *calibrated, "-p", "target_localizer.max_range:=0.2")
    assert "board" not in near and near["message"]
    red = ("-p", "powerline_mapper.detection.appearance:=red")
    assert [len(detections(wire, *more)["wires"]) for more in ((), red, (*red, "-p", "powerline_mapper.detection.redness:=150"))] == [0, 1, 0]
    capsys.readouterr()
    for parameter, words in (("vio.filter.clones:=8", "does not apply to images"), ("target_localizer.mode:=fused", "does not apply to images"),
                             ("powerline_mapper.rate:=5.0", "does not apply to images"), ("target_localizer.board:=none", "unknown"),
                             ("powerline_mapper.detection.redness:=999", "redness"), ("controller.x:=1", "is not one of")):
        assert perceive(wire, "--out", out, "-p", parameter) == 2, parameter
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and said[0].startswith("error: ") and words in said[0], said


def test_what_cannot_be_done_is_said_in_a_line(files, tmp_path, capsys):
    broken, empty, elsewhere = tmp_path / "broken.mcap", tmp_path / "empty", tmp_path / "truth.tum"
    whole = next((files / "mcap").glob("*.mcap")).read_bytes()
    broken.write_bytes(whole[:1000])
    empty.mkdir()
    elsewhere.write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    mine, asl = files / "mine.yaml", files / "asl"
    for arguments, words in (
        ((tmp_path / "none",), "no such recording"),
        ((empty,), "is no recording"),
        ((broken, "--sensors", mine), "cannot be read"),
        ((files / "mcap",), "--sensors"),
        ((asl, "--camera", "left"), "is not one of cam0"),
        ((asl, "--truth", tmp_path / "none.tum"), "is no file"),
        ((asl, "--truth", mine), "is no trajectory"),
        ((asl, "--board", "none"), "unknown"),
        ((asl, "-p", "vio.nonsense:=1"), "nonsense"),
        ((asl, "-p", "controller.x:=1"), "is not one of"),
    ):
        assert perceive(*arguments, "--out", tmp_path / "out") == 2, arguments
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and said[0].startswith("error: ") and words in said[0], said
    assert perceive(asl, "--out", mine / "below") == 2


def test_of_photographs_the_named_camera_is_used(flight, files, tmp_path, capsys):
    photo, sensors, out = tmp_path / "a.png", tmp_path / "two.yaml", tmp_path / "out"
    cv2.imwrite(str(photo), flight.images[5])
    described = yaml.safe_load((files / "mine.yaml").read_text())
    one, = described["cameras"].values()
    described["cameras"] = {"down": one, "front": {**one, "focal": [2.0 * focal for focal in one["focal"]]}}
    sensors.write_text(yaml.safe_dump(described))
    distance = {}
    for option in ((), ("--front", "down"), ("--front", "front"), ("--camera", "front")):
        assert perceive(photo, "--sensors", sensors, *option, "--out", out) == 0
        distance[option[1:]] = json.loads((out / "detections.json").read_text())["a.png"]["board"]["position"][2]
    assert distance["down",] == distance[()] < 0.7 * distance["front",]
    capsys.readouterr()
    assert perceive(photo, "--sensors", sensors, "--front", "rear", "--out", out) == 2
    assert "rear: is not one of down, front" in capsys.readouterr().err


def test_images_of_one_name_or_stamp_are_all_counted():
    taken: dict[str, None] = {}
    for camera in ("cam0", "cam0", "cam1", "cam1", "cam1"):
        taken[_unused(taken, "1.png", camera)] = None
    assert list(taken) == ["1.png", "cam0/1.png", "cam1/1.png", "cam1/1.png (2)", "cam1/1.png (3)"]


def test_an_image_of_another_size_is_left_out_and_ends_nothing(files):
    file, texts = str(files / "mine.yaml"), []
    made = Perception(load_sensors(file), file, "cam0", "cam0", "pad_four_tags", {}, [])
    for node in (made.target, made.wires):
        node.log.receivers.append(lambda line: texts.append(line.text))
        for stamp in (1_000_000_000, 1_010_000_000, 1_020_000_000):
            node.on_odometry(OdometryState(stamp, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, 1e-4 * np.eye(6), 1e-4 * np.eye(6)))
        node.on_image(CameraImage(1_020_000_000, "", 64, 48, "mono8", np.zeros((48, 64), np.uint8)))
    assert "64 x 48" in made.sightings[-1].message and sum("64 x 48" in text for text in texts) == 2
    assert made.target.missed.images == [] == made.wires.gallery.images


def test_an_interrupt_leaves_no_report(files, tmp_path, monkeypatch, capsys):
    def events(self):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(AslRecording, "events", events)
    assert perceive(files / "asl", "--out", tmp_path) == 130
    assert not (tmp_path / "report.html").exists() and "Traceback" not in capsys.readouterr().err
