"""Preflight: what is sound passes, every wrong axis, rate, stamp, clock and unit is named, and nothing is exercised unasked."""

import os
import signal
from contextlib import closing
from dataclasses import replace
from itertools import permutations, product
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from perch_core.camera import PinholeCamera
from perch_core.component import Diagnostics
from perch_core.errors import ConfigError, PerchError
from perch_core.ros.topics import topic
from perch_core.sensors import CameraSensor, Sensors, load_sensors
from perch_core.urdf import fixed_frames
from perch_core.values import CameraModel, ControllerCommand, ControllerStatus, ImuSample, MotorCommand, RotorState
from perch_core.vehicle import load_vehicle
from perch_eval.domain import reserved_domain
from perch_eval.preflight import checks, command
from perch_eval.camera_turns import CameraTurns, rotation_between
from perch_eval.preflight.checks import CommandResult, Verdict
from perch_eval.preflight.ros import listener
from scipy.spatial.transform import Rotation
from unit.controller_flight import Flight

VEHICLE = load_vehicle("snapdragon")
PASSED, FAILED, OPEN = Verdict.PASSED, Verdict.FAILED, Verdict.OPEN
MS = 1_000_000
AXES = [R for order in permutations(range(3)) for signs in product((1, -1),
                                                                   repeat=3) if np.linalg.det(R := np.diag(signs)[:,
                                                                                                                  order].astype(float)) > 0]


def verdicts(found):
    return {check.name: check.verdict for check in found}


def still(R=np.eye(3), scale=1.0, spin=0.0, seed=1):
    """A second of an IMU at rest whose axes are turned by R."""
    rng = np.random.default_rng(seed)
    f = scale * (R @ np.array([0.0, 0.0, 9.81]) + 0.3 * rng.standard_normal((500, 3)))
    w = spin + 0.01 * rng.standard_normal((500, 3))
    return [ImuSample(k * 2 * MS, tuple(w[k]), tuple(f[k])) for k in range(500)]


@pytest.mark.parametrize("k", range(24))
def test_every_wrong_axis_is_found_by_gravity_or_by_shaking(k):
    R = AXES[k]
    seen = verdicts(checks.check_at_rest(still(R)))
    assert seen["gravity's size"] is PASSED and seen["gyroscope at rest"] is PASSED
    assert (seen["gravity up"] is PASSED) == (R[2, 2] == 1.0)
    rng = np.random.default_rng(k)
    rates = rng.standard_normal((60, 3))  # of the body; its IMU says R of it, the camera what its mount makes of it
    check = checks.check_rotation("down", rates @ R.T + 0.02 * rng.standard_normal((60, 3)), rates @ VEHICLE.mounts["down"].R_BC, VEHICLE)
    assert (check.verdict is PASSED) == bool((R == np.eye(3)).all())


def test_units_and_motion_are_seen():
    assert verdicts(checks.check_at_rest(still(scale=1 / 9.81)))["gravity's size"] is FAILED
    assert verdicts(checks.check_at_rest(still(spin=0.2)))["gyroscope at rest"] is FAILED
    assert verdicts(checks.check_at_rest([]))["gravity up"] is FAILED


@pytest.mark.parametrize("stamps, rate, even", [
    ([k * 2 * MS for k in range(500)], PASSED, PASSED), ([k * 20 * MS for k in range(50)], FAILED, PASSED),
    ([k * 2 * MS + 30 * MS * (k > 200) for k in range(500)], PASSED, FAILED),
                                                ([k * 2 * MS - 4 * MS * (k == 200) for k in range(500)], PASSED, FAILED)])
def test_rates_and_stamps(stamps, rate, even):
    assert list(verdicts(checks.check_stream("imu/data_raw", stamps)).values()) == [rate, even]


def test_silence_fails():
    assert [check.verdict for check in checks.check_stream("odometry", [])] == [FAILED]
    assert [check.verdict for check in checks.check_frames(None, still()[0], True)] == [FAILED, PASSED]
    assert checks.check_frames(None, still()[0]._replace(frame="fcu"), False)[1].verdict is FAILED


@pytest.mark.parametrize("shift, verdict", [(0.03, PASSED), (0.6, FAILED), (-0.4, FAILED), (1.7e9, FAILED)])
def test_clocks_are_compared_though_this_program_is_late(shift, verdict):
    rng = np.random.default_rng(5)
    imu = [(100.0 + 0.002 * k + rng.exponential(0.05), k * 2 * MS) for k in range(1000)]
    frames = [(100.0 + 0.033 * k + shift + rng.exponential(0.05), k * 33 * MS) for k in range(60)]
    assert [check.verdict for check in checks.check_clocks(imu, {"down": frames})] == [verdict]


def test_cameras_and_extrinsics_are_compared_with_the_file():
    camera = VEHICLE.mounts["down"].camera
    model = CameraModel(0, "camera_down_optical_frame", camera)
    assert checks.check_camera_model("down", model, VEHICLE).verdict is PASSED
    c = camera
    other_lens = PinholeCamera(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
    for wrong in (replace(c, fx=1.1 * c.fx), replace(c, cx=c.cx + 80.0), other_lens, replace(c, width=c.width + 2)):
        assert checks.check_camera_model("down", model._replace(camera=wrong), VEHICLE).verdict is FAILED
    for wrong in (model._replace(frame="down"), None):
        assert checks.check_camera_model("down", wrong, VEHICLE).verdict is FAILED
    frames = list(fixed_frames(VEHICLE))
    assert {check.verdict for check in checks.check_extrinsics(frames, VEHICLE, VEHICLE)} == {PASSED}
    assert {check.verdict for check in checks.check_extrinsics([], VEHICLE, VEHICLE)} == {OPEN}
    moved = [f._replace(p=(f.p[0] + 0.05, *f.p[1:])) if f.child.startswith("camera_front") else f for f in frames]
    failed = [check.name for check in checks.check_extrinsics(moved, VEHICLE, VEHICLE) if check.verdict is FAILED]
    assert failed == ["extrinsics camera_front_optical_frame"]


def test_cameras_of_a_sensor_file_may_be_mounted_otherwise_than_description_has_them():
    file = described(down=RADTAN)
    frames = list(fixed_frames(VEHICLE))
    check = next(check for check in checks.check_extrinsics(frames, VEHICLE, file) if "camera_down" in check.name)
    assert check.verdict is OPEN and "`extrinsics: file`" in check.advice
    assert {check.name: "description" in check.advice for check in checks.check_extrinsics([], VEHICLE, file)} == {
        f"extrinsics {f.child}": not f.child.startswith("camera") for f in fixed_frames(VEHICLE, file.mounts)}
    assert [check.verdict for check in checks.check_stream("camera_down/camera_info", [0], OPEN)] == [FAILED]


def described(**cameras):
    return Sensors(name="mine", cameras=cameras)


RADTAN = CameraSensor(model="radtan", width=640, height=480, focal=(400.0, 400.0), centre=(320.0, 240.0), distortion=(-0.28, 0.07, 0.0002, 0.0),
                      position=(0.1, 0.0, 0.0), orientation=(-0.5, 0.5, -0.5, 0.5))
EQUIDISTANT = replace(RADTAN, model="equidistant", distortion=(0.0039, -0.0096, 0.0102, -0.0033))


@pytest.mark.parametrize("sensor", [RADTAN, EQUIDISTANT])
def test_cameras_of_a_sensor_file_are_those_that_are_compared(sensor, monkeypatch):
    monkeypatch.setattr(command, "load_sensors", lambda name: described(down=sensor, cam0=RADTAN))
    monkeypatch.setattr(command, "imu_in_body", lambda *_: still())
    mounts = described(down=sensor, cam0=RADTAN).mounts
    model = CameraModel(0, "of its driver", sensor.camera)
    graph = SimpleNamespace(values={"imu/data_raw": [], "odometry": [], "/tf_static": [(0.0, f) for f in fixed_frames(VEHICLE, mounts)],
                                    "camera_down/camera_info": [(0.0, model)], "camera_cam0/camera_info": []})
    graph.newest = lambda channel: graph.values[channel][-1][1] if graph.values[channel] else None
    graph.arrivals_and_stamps = lambda channel: []
    cameras = command.described_cameras(VEHICLE, "mine")
    seen = verdicts(command.passive_checks(graph, VEHICLE, cameras, "mine"))
    assert seen["camera_down model"] is seen["extrinsics camera_down_optical_frame"] is seen["extrinsics camera_cam0_optical_frame"] is PASSED
    assert seen["camera_cam0 model"] is seen["rate camera_cam0/camera_info"] is OPEN, "the nodes use the file's"
    assert seen["rate camera_down/camera_info"] is seen["rate imu/data_raw"] is FAILED
    assert [(name, seen[name]) for name in seen if "front" in name] == [("camera_front", OPEN)], "it is not described"
    rates = np.random.default_rng(6).standard_normal((60, 3))
    assert checks.check_rotation("cam0", rates, rates @ mounts["cam0"].R_BC, described(cam0=RADTAN)).verdict is PASSED
    monkeypatch.setattr(command, "load_sensors", lambda name: Sensors(name="mine"))
    assert command.described_cameras(VEHICLE, "mine") is VEHICLE, "as the nodes: its cameras count where the file has none"


@pytest.mark.parametrize("sent, words", [
    ({"distortion": (-0.1, 0.07, 0.0002, 0.0)}, "lens differs: mine has 640 x 480 px, plumb_bob"), ({"distortion": ()}, "lens differs:"),
    ({"model": "equidistant"}, "lens differs:"), ({"width": 320}, "image size differs:"),
    ({"width": 320, "focal": (200.0, 200.0)}, "image size and lens differ:")])
def test_what_differs_from_the_sensor_file_is_named(sent, words):
    model = CameraModel(0, "of its driver", replace(RADTAN, **sent).camera)
    check = checks.check_camera_model("cam0", model, described(cam0=RADTAN))
    assert check.verdict is FAILED and words in check.advice and "distortion [-0.28, 0.07, 0.0002, 0.0" in check.advice
    assert "frame" not in check.advice


@pytest.mark.parametrize("name", ["left eye", "a.b", "stereo-left"])
def test_a_camera_whose_name_makes_no_topic_is_refused_with_its_file(name, tmp_path):
    sensors, vehicle = tmp_path / "eyes.yaml", tmp_path / "quad.yaml"
    sensors.write_text(f"name: eyes\ncameras:\n  {name}: {{model: pinhole, width: 64, height: 48, focal: [60, 60], centre: [32, 24]}}\n")
    vehicle.write_text(f"extends: snapdragon\ncameras:\n  {name}: {{model: pinhole, width: 64, height: 48, focal: [60, 60], centre: [32, 24], "
                       "position: [0, 0, 0], orientation: [0, 0, 0, 1]}\n")
    for load, file in ((load_sensors, sensors), (load_vehicle, vehicle)):
        with pytest.raises(ConfigError, match=f"{file.name}.*: cameras: '{name}' is no name of a camera"):
            load(file)


def test_the_graph_is_asked_for_the_cameras_that_are_described(monkeypatch):
    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with closing(listener.GraphListener(VEHICLE, cameras=("cam0", "1"))) as graph:
            assert {name for name in graph.values if name.startswith("camera")} == {"camera_cam0/camera_info", "camera_1/camera_info"}


@pytest.mark.parametrize("felt, words", [
    (lambda w, other: 57.3 * w, "57.3 times"), (lambda w, other: 0.5 * w, "0.5 times"), (lambda w, other: (1.0, 1.0, 0.5) * w, "times"),
    (lambda w, other: w + 0.6 * other, "are not the camera's")])
def test_a_gyroscope_with_another_scale_or_another_motion_is_found(felt, words):
    rates, other = np.random.default_rng(6).standard_normal((2, 60, 3))
    check = checks.check_rotation("down", felt(rates, other), rates @ VEHICLE.mounts["down"].R_BC, VEHICLE)
    assert check.verdict is FAILED and words in check.observation


def test_rates_that_are_no_numbers_are_found():
    rates = np.random.default_rng(6).standard_normal((60, 3))
    rates[7, 1] = np.nan
    check = checks.check_rotation("down", rates, rates @ VEHICLE.mounts["down"].R_BC, VEHICLE)
    assert check.verdict is FAILED and "not finite" in check.observation
    assert verdicts(checks.check_at_rest(still(spin=np.nan)))["gyroscope at rest"] is FAILED


def test_shaking_too_little_is_no_verdict():
    rates = np.outer(np.sin(np.arange(60)), (1.0, 0.0, 0.0))  # about one axis alone
    assert checks.check_rotation("down", rates, rates, VEHICLE).verdict is OPEN
    assert checks.check_rotation("down", rates[:5], rates[:5], VEHICLE).verdict is OPEN


def test_rotations_are_found_among_false_rays():
    rng = np.random.default_rng(2)
    after = rng.standard_normal((80, 3))
    after /= np.linalg.norm(after, axis=1)[:, None]
    R = Rotation.from_rotvec([0.05, -0.08, 0.03])
    before = R.apply(after)
    before[:8] = -before[:8]
    assert np.abs(rotation_between(before, after) - R.as_matrix()).max() < 1e-3


def test_a_camera_is_seen_to_turn():
    """A textured plane at infinity through a pinhole camera: a turn by R is the homography K R^T K^-1."""
    rng, camera = np.random.default_rng(3), load_vehicle("rpg").mounts["front"].camera
    picture = cv2.GaussianBlur(rng.integers(0, 256, (camera.height, camera.width)).astype(np.uint8), (0, 0), 4.0)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    turns, rate = CameraTurns(camera), np.array([0.4, -0.6, 0.8])
    for k in range(4):
        R = Rotation.from_rotvec(rate * 0.033 * k).as_matrix()
        turns.add(k * 33 * MS, cv2.warpPerspective(picture, camera.K @ R.T @ np.linalg.inv(camera.K), (camera.width, camera.height),
                                                   borderMode=cv2.BORDER_REFLECT))
    assert len(turns.spans) == 3
    for _, _, seen in turns.spans:
        np.testing.assert_allclose(seen, rate, atol=0.06)
    stamps = np.arange(0, 110) * MS
    gyro, seen = turns.paired(stamps, np.tile(rate, (110, 1)), -0.005)
    assert len(gyro) == 3 and np.abs(gyro - seen).max() < 0.06


class Graph:
    """A vehicle that obeys, or does not."""

    def __init__(self, obeys=True):
        self.commands, self.obeys = [], obeys
        self._killed = False  # since the autopilot's last report, once a second

    def send_command(self, sent, state):
        self._killed |= sent == command.Command.KILL
        self.commands.append(sent)
        status = ControllerStatus(0, state if self.obeys else 0, "geometric", 0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, "said")
        return CommandResult(status, 0.1, state == command.State.ARMED and self.obeys)

    def spin_for(self, duration):
        self._killed &= duration <= 1.0 or self.commands[-1] != command.Command.DISARM

    def await_takeover(self, timeout):
        assert self.commands[-1] == command.Command.ARM and not self._killed
        return True, True

    def await_end_of_commands(self, timeout):
        assert self.commands[-1] == command.Command.ARM and not self._killed
        return 10.0, 10.4


def asked(*options):
    return command.parser().parse_args(["--vehicle", "snapdragon", *options])


ALL = asked("--props-off", "--takeover", "--watchdog")


def test_motors_start_only_where_the_propellers_are_off():
    graph = Graph()
    assert {check.verdict for check in command.active_checks(graph, asked("--takeover", "--watchdog"))} == {OPEN} and not graph.commands
    seen = verdicts(command.active_checks(graph, ALL))
    assert [seen[name] for name in ("armed state", "disarming", "kill", "pilot's takeover", "watchdog")] == [PASSED] * 5
    assert graph.commands[-2:] == [command.Command.KILL, command.Command.DISARM], "it is left with the motors off"


def test_who_does_not_arm_fails_and_is_not_tried_further():
    graph = Graph(obeys=False)
    seen = verdicts(command.active_checks(graph, ALL))
    assert seen["armed state"] is FAILED and seen["kill"] is seen["watchdog"] is seen["pilot's takeover"] is OPEN
    sent = command.Command
    assert graph.commands == [sent.ARM, sent.DISARM, sent.ARM, sent.KILL, sent.DISARM]


@pytest.mark.parametrize("turned, armed, verdict", [(True, True, PASSED), (True, None, FAILED), (True, False, OPEN), (False, None, OPEN)])
def test_motors_that_go_on_though_the_pilot_has_taken_over_fail(turned, armed, verdict):
    assert checks.check_takeover(turned, armed).verdict is verdict


@pytest.mark.parametrize("motion, verdict", [(10.3, PASSED), (11.5, FAILED), (None, OPEN)])
def test_motors_that_go_on_without_commands_fail(motion, verdict):
    assert checks.check_watchdog(10.0, motion).verdict is verdict


class Bench(listener.GraphListener):
    """The listener, in place of whose graph the clock and the messages are the test's: motor commands every 0.1 s until 3 s."""

    def __init__(self, monkeypatch, said, namespace=""):
        """said: time [s] -> (channel, value) of each message of that time."""
        self.values = {channel: [] for channel in listener.CHANNELS}
        self._speed_max, self._namespace, self._said, self._now = 1000.0, namespace, said, 0.0
        monkeypatch.setattr(listener.time, "monotonic", lambda: self._now)

    def spin_for(self, duration):
        self._now += duration
        sent = [("motor_command", MotorCommand(0, self._now < 2.95, (0.0,) * 4))] if self._now < 3.05 else []
        for channel, value in (*sent, *self._said(self._now)):
            self.values[channel].append((self._now, value))


def rotors(speed):
    return [("rotor_state", RotorState(0, (speed,) * 4, (0.0,) * 4))]


def armed(armed, node="/betaflight"):
    return [("/diagnostics", Diagnostics(0, {"node": node, "armed": str(armed)}))]


@pytest.mark.parametrize("said, snapdragon, autopilot", [
    (lambda t: rotors(500.0 * (t < 3.5)), PASSED, PASSED), (lambda t: armed(t < 3.5), PASSED, PASSED),
    (lambda t: rotors(500.0 * (t < 6.0)), FAILED, PASSED), (lambda t: rotors(500.0), FAILED, FAILED), (lambda t: armed(True), FAILED, FAILED),
    (lambda t: rotors(0.0), OPEN, OPEN), (lambda t: armed(False), OPEN, OPEN), (lambda t: [], OPEN, OPEN),
    (lambda t: rotors(500.0) if t < 3.5 else [], OPEN, OPEN), (lambda t: armed(True) if t < 3.5 else [], OPEN, OPEN),
    (lambda t: rotors(500.0 * (t < 2.0)), OPEN, OPEN), (lambda t: rotors(500.0 * (t > 3.5)), OPEN, OPEN)])
def test_the_watchdog_is_judged_by_motors_that_turned_until_the_last_command_and_were_seen_to_stop(monkeypatch, said, snapdragon, autopilot):
    ends = Bench(monkeypatch, said).await_end_of_commands(60.0)
    assert checks.check_watchdog(*ends).verdict is snapdragon
    assert checks.check_watchdog(*ends, checks.DESCENT_TIME).verdict is autopilot


def test_the_controller_obeys_though_odometry_has_stopped_and_the_imu_goes_on(monkeypatch):
    """At the end of preflight, the motors would go on otherwise."""
    flight, sent = Flight(), []
    flight.step(0.1)
    flight.component.on_command(ControllerCommand(0, command.Command.ARM, ""))
    flight.step(0.1)
    last = flight.odometry()
    flight.step(2.0, odometry=False)
    bench = Bench(monkeypatch, lambda t: [])
    bench.values["odometry"].append((0.0, last))
    bench.spin_until = lambda done, timeout: None
    bench._command_publisher = SimpleNamespace(publish=sent.append)
    bench.send_command(command.Command.KILL, command.State.FAILED)
    assert flight.component.flight.state is command.State.ARMED
    flight.component.on_command(topic("controller/command").to_value(sent[0]))
    assert flight.component.flight.state is command.State.FAILED


def test_another_vehicle_is_not_taken_for_this_one(monkeypatch):
    """`quad1` stays armed; `quad2` is disarmed at 1 s, by its pilot."""
    def said(t):
        return armed(True, "/quad1/betaflight") + armed(t < 1.0, "/quad2/betaflight")

    assert checks.check_takeover(*Bench(monkeypatch, said, "quad1").await_takeover(2.0)).verdict is FAILED
    assert checks.check_takeover(*Bench(monkeypatch, said, "quad2").await_takeover(2.0)).verdict is PASSED
    assert checks.check_takeover(*Bench(monkeypatch, said).await_takeover(2.0)).verdict is OPEN
    assert checks.check_watchdog(*Bench(monkeypatch, said, "quad1").await_end_of_commands(60.0)).verdict is FAILED


def test_each_node_of_a_vehicle_is_a_source_of_its_own(monkeypatch):
    """One says that the motors stop, the other one that they go on."""
    def said(t):
        return armed(True, "/mavlink") + armed(t < 1.0, "/betaflight")

    assert checks.check_takeover(*Bench(monkeypatch, said).await_takeover(2.0)).verdict is FAILED


@pytest.mark.parametrize("error", [KeyboardInterrupt, PerchError])
@pytest.mark.parametrize("wait", ["await_takeover", "await_end_of_commands"])
def test_a_check_that_is_interrupted_leaves_the_motors_off(wait, error):
    def interrupted(timeout):
        raise error

    graph = Graph()
    setattr(graph, wait, interrupted)
    with pytest.raises(error):
        command.active_checks(graph, ALL)
    assert graph.commands[-3:] == [command.Command.ARM, command.Command.KILL, command.Command.DISARM]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_terminal_that_is_closed_is_an_interrupt_too(number, monkeypatch):
    """As of a lost connection to the companion computer: preflight ends, and the motors with it."""
    before = signal.getsignal(number)
    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with closing(listener.GraphListener(VEHICLE)) as graph, pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
            graph.spin_for(60.0)
    assert signal.getsignal(number) is before


def test_an_autopilot_may_descend_before_its_motors_stop():
    graph = Graph()
    graph.await_end_of_commands = lambda timeout: (10.0, 14.2)  # its watchdog's four seconds
    assert verdicts(command.active_checks(graph, ALL))["watchdog"] is FAILED
    assert verdicts(command.active_checks(graph, ALL, checks.DESCENT_TIME))["watchdog"] is PASSED


@pytest.mark.parametrize("arguments, words", [(["--vehicle", "nothing"], "nothing: unknown"),
                                              (["--vehicle", "rpg_published", "--listen", "0"], "[1, 300] s"),
                                              (["--vehicle", "rpg_published", "--takeover"], "needs --props-off"),
                                              (["--vehicle", "rpg_published", "--watchdog"], "needs --props-off")])
def test_mistakes_are_one_line(arguments, words, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["preflight.py", *arguments])
    assert command.main() == 2
    line = capsys.readouterr().err
    assert words in line and line.count("\n") == 1
