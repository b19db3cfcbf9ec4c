"""Betaflight's own firmware: in the loop, flown through, spoken to over MSP. Skipped where it has not been built."""

from __future__ import annotations

import os
import re
import select
import signal
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from perch_autopilot import firmware, msp, sitl
from perch_autopilot.betaflight import Betaflight, BetaflightParameters
from perch_autopilot.configuration import Cli, CliError, Configuration, load_configuration
from perch_autopilot.loop import FirmwareLoop
from perch_autopilot.namespace import IsolatedProgram, NamespaceError
from perch_autopilot.sitl import GRAVITY, LEVEL, Sitl
from perch_autopilot.watchdog import CENTRED, OFF, ON, Mode
from closed_loop.supervised_loop import Body
from perch_core import config
from perch_core.component import Output, ports
from perch_core.values import RatesThrust
from perch_core.vehicle import Battery, load_vehicle
from perch_eval.identification import command
from perch_eval.in_process import fly
from perch_eval.preflight.ros.listener import CHANNELS, GraphListener
from perch_sim.scenario import load_scenario
from scipy.spatial.transform import Rotation

try:
    firmware.find_program()
except firmware.FirmwareError as missing:
    pytest.skip(str(missing), allow_module_level=True)

VEHICLE = load_vehicle("betaflight")
STILL = (0.0, 0.0, 0.0)


def started(make):
    """What runs in a namespace; a machine that gives none skips the test."""
    try:
        return make()
    except NamespaceError as error:
        pytest.skip(str(error))


class Reading:
    def __init__(self, gyro):
        self.gyro, self.accel = np.array(gyro), np.array(GRAVITY)


def outputs() -> list[np.ndarray]:
    """Rotor speeds of a firmware that is shaken for 0.6 s after it was armed."""
    loop, rng, state = started(lambda: FirmwareLoop(VEHICLE)), np.random.default_rng(1), np.r_[np.zeros(6), 1.0, np.zeros(6)]
    try:
        said = []
        for k in range(300):
            loop.command(0, True, (0.3 * np.sin(k / 20), 0.0, 0.1), 9.81)
            said.append(loop.speeds(0, state, np.zeros(4), Reading(0.05 * rng.standard_normal(3))))
        return said
    finally:
        loop.close()


def test_a_packet_has_one_answer_and_without_one_there_is_none(monkeypatch):
    """An answer too many would be read in place of the next: the simulator and the firmware would run side by side from then on."""
    with monkeypatch.context() as patched:
        patched.setattr(Sitl, "step", lambda *_: None)
        running = started(lambda: Sitl(load_configuration("betaflight")))
    try:
        answers = running._running.received
        assert not select.select([answers], [], [], 0.1)[0]
        for _ in range(100):
            running.step(STILL, GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
            assert not select.select([answers], [], [], 0.0)[0]
    finally:
        running.close()


def test_two_runs_agree_to_the_last_bit_and_a_turn_drives_the_right_rotors():
    first, second = outputs(), outputs()
    assert np.array_equal(first, second) and min(first[-1]) >= VEHICLE.speed_min
    loop, state = started(lambda: FirmwareLoop(VEHICLE)), np.r_[np.zeros(6), 1.0, np.zeros(6)]
    try:
        for axis in range(3):
            for sign in (1.0, -1.0):
                for k in range(60):
                    loop.command(0, True, tuple(sign * np.eye(3)[axis] * (k >= 40)), 9.81)
                    speeds = loop.speeds(0, state, np.zeros(4), Reading(STILL))
                moments = VEHICLE.allocation @ speeds**2
                assert np.argmax(np.abs(moments[1:] / VEHICLE.allocation[1:, 0])) == axis and sign * moments[1 + axis] > 0.0
                for _ in range(60):
                    loop.command(0, True, STILL, 9.81)
                    loop.speeds(0, state, np.zeros(4), Reading(STILL))
        loop.command(0, False, STILL, 9.81)
        assert not [loop.speeds(0, state, np.zeros(4), Reading(STILL)) for _ in range(5)][-1].any()
    finally:
        loop.close()


def test_a_wall_is_perched_on_through_the_firmware():
    trace = started(lambda: fly(replace(load_scenario("surface_90"), vehicle="betaflight"), 1))
    assert trace.outcome == "perched", trace.message


@pytest.mark.parametrize("vehicle", ["betaflight", "rpg_betaflight"])
def test_vehicle_files_are_what_identification_writes(vehicle, undrawn, tmp_path, monkeypatch, capsys):
    """What flies changes, and numerics of another machine may: within three standard deviations, as the files give them.

    Half of the flight is flown that they are from, all of its moves once: of the drag it tells too little for a file, but what it tells is that.
    """
    monkeypatch.setattr("sys.argv", ["identify.py", "--vehicle", f"{vehicle}_unidentified", "--name", vehicle, "--out", str(tmp_path)])
    monkeypatch.setattr(command.flight, "ROUNDS", 1)
    started(lambda: Sitl(load_configuration("betaflight"))).close()
    assert command.main() in (0, 1)
    file, found = config.config_dir() / "vehicles" / f"{vehicle}.yaml", dict(re.findall(r"^(\S+) +([\d.e-]+) \+-", capsys.readouterr().out, re.MULTILINE))
    shipped, text = load_vehicle(vehicle), file.read_text()
    assert load_vehicle(tmp_path / "vehicle.yaml").name == shipped.name == vehicle
    for key, then in {f"actuation.{field}": getattr(shipped.actuation, field) for field in ("rate_lag", "rate_gain", "delay", "thrust_lag", "thrust_gain")
                      }.items() | {"drag": shipped.drag[:1]}.items():  # along the other axes not even the whole flight tells it
        sigma = np.array([float(word) for word in re.findall(r"\+- ([\d.e-]+)", re.search(rf"^ *{key.split('.')[-1]}:.*#(.*)$", text, re.MULTILINE)[1])])
        now = np.array([float(found[key])] if key in found else [float(found[f"{key}[{axis}]"]) for axis in range(len(sigma))])
        assert now.shape == np.shape(np.atleast_1d(then)) == sigma.shape and (np.abs(now - then) <= 3.0 * sigma).all(), (key, now, then, sigma)

    def keys(file):
        return {line.split(":")[0].strip() for line in file.read_text().splitlines() if not line.lstrip().startswith("#")}

    assert keys(file) == keys(tmp_path / "vehicle.yaml") | {"drag"}  # and nothing by hand


def command_line(running) -> Cli:
    """Of a firmware in the loop: it opens it after a pause of its own time, which is that of the packets."""
    def receive(silence: float) -> bytes:
        if data := running.receive(silence):
            return data
        for _ in range(60):  # longer than the pause; and on a busy machine its turn to write comes, too
            running.step(STILL, GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
        return running.receive(silence)

    return Cli(running.send, receive)


def test_the_configuration_is_read_back_and_what_differs_is_named():
    loaded = load_configuration("betaflight")
    running = started(lambda: Sitl(loaded))
    try:
        cli = command_line(running)
        cli.check(loaded)
        wrong = Configuration("mine.txt", (*loaded.lines, "set p_roll = 1"))
        with pytest.raises(CliError, match="p_roll is 180, not 1"):
            cli.check(wrong)
        with pytest.raises(CliError, match="mine.txt: set no_such = 1: the firmware refuses it"):
            cli.apply(Configuration("mine.txt", ("set no_such = 1",)))
    finally:
        running.close()


def test_its_time_is_that_of_the_packets_and_no_pause_counts():
    running = started(lambda: Sitl(load_configuration("betaflight")))
    try:
        for _ in range(500):
            running.step(STILL, GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
        time.sleep(2.5)  # more than seconds, which are cut, and the tolerance hide
        cli = command_line(running)
        asked = running.time
        uptime = re.search(r"System Uptime: (\d+) seconds", cli.query("status"))
        assert int(uptime[1]) == pytest.approx(60.0 + asked, abs=1.0)  # it begins with 60
    finally:
        running.close()


def test_a_firmware_that_freezes_is_named(tmp_path, monkeypatch):
    loaded = load_configuration("betaflight")
    running = started(lambda: Sitl(loaded))
    try:
        running._running.received.settimeout(0.05)
        running._running.process.send_signal(signal.SIGSTOP)
        with pytest.raises(sitl.FirmwareTimeoutError, match="has not answered"):
            for _ in range(100):  # what it had begun it may answer
                running.step(STILL, GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
    finally:
        running.close()
    program, launched = tmp_path / "asleep", []
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o700)
    (tmp_path / f"{loaded.identity}.eeprom").touch()
    monkeypatch.setattr(firmware, "find_program", lambda: program)
    monkeypatch.setattr(sitl, "_START", 0.1)
    monkeypatch.setattr(sitl, "IsolatedProgram", lambda *words: launched.append(IsolatedProgram(*words)) or launched[-1])
    with pytest.raises(sitl.FirmwareTimeoutError, match="does not open its port"):
        Sitl(loaded)
    assert [one.process.poll() is not None for one in launched] == [True]


def test_no_folder_stays_and_those_of_the_killed_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    old, new = tmp_path / "perch-betaflight-old", tmp_path / "perch-betaflight-new"
    for folder in (old, new):
        folder.mkdir()
        (folder / "eeprom.bin").touch()
    os.utime(old, (time.time() - 7200.0,) * 2)
    running = started(lambda: Sitl(load_configuration("betaflight")))
    try:
        assert list(tmp_path.iterdir()) == [new]  # of another one that is about to start; ours is gone before the first flight
        running.step(STILL, GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
    finally:
        running.close()


# -- the node's component, over the firmware's MSP ---------------------------------------------------------------------

class Vehicle:
    """A firmware on a bench that lives by the wall clock, with a pilot's radio."""

    def __init__(self) -> None:
        self.sitl = started(lambda: FirmwareLoop(VEHICLE).sitl)
        self.radio = [1500, 1500, 1000, 1500, OFF, OFF, ON]  # the last one hands over to the companion computer
        self.motors, self.gyro, self._on = (0.0,) * 4, STILL, True
        self.history: list[tuple[float, tuple[float, ...]]] = []
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _live(self) -> None:
        while self._on:
            self.motors = self.sitl.step(self.gyro, GRAVITY, LEVEL, tuple(self.radio))
            self.history.append((time.monotonic(), self.motors))
            time.sleep(0.002)

    @property
    def turning(self) -> bool:
        return min(self.motors) > 0.02

    def close(self) -> None:
        self._on = False
        self._thread.join()
        self.sitl.close()


def until(what, seconds=120.0, often=lambda: None):
    """Wait for something, doing what has to be done meanwhile."""
    last = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < last, "it does not come"
        often()
        time.sleep(0.01)


@pytest.fixture
def vehicle():
    one = Vehicle()
    yield one
    one.close()


def component(vehicle) -> tuple[Betaflight, dict]:
    node = Betaflight(BetaflightParameters(link=f"fd:{vehicle.sitl.file}", one_g=256.0))
    got: dict = {}
    for port in ports(Betaflight, Output):
        getattr(node, port.name).receivers.append(got.setdefault(port.name, []).append)
    return node, got


def test_the_node_arms_flies_levels_and_hands_over(vehicle):
    node, got = component(vehicle)
    try:
        assert str(node.version) == "BTFL 4.6.0"

        def poll(armed=None, thrust=9.81):
            if armed is not None:
                node.on_rates_thrust(RatesThrust(0, armed, STILL, thrust))
            node.on_poll(time.monotonic_ns())

        poll(False)
        until(lambda: vehicle.turning, often=lambda: poll(True))
        until(lambda: min(vehicle.motors) > 0.2, often=lambda: poll(True))        # and the throttle follows
        vehicle.gyro = (0.5, 0.0, 0.0)
        until(lambda: got["imu"] and abs(got["imu"][-1].w_B[0] - 0.5) < 0.02, often=lambda: poll(True))
        assert got["imu"][-1].f_B[2] == pytest.approx(9.81, abs=0.3)
        vehicle.gyro = STILL
        vehicle.radio[6], vehicle.radio[4] = OFF, ON                              # the pilot takes over, armed, throttle down
        until(lambda: max(vehicle.motors) < 0.1 and vehicle.turning, often=lambda: poll(True))
        vehicle.radio[6] = ON
        until(lambda: min(vehicle.motors) > 0.2, often=lambda: poll(True))        # and gives it back
        node.close()                                                              # as a node that is killed
        until(lambda: not vehicle.turning)                                        # level, down, off
    finally:
        node.close()


def test_what_flies_goes_on_when_node_or_supervisor_are_started_anew(vehicle):
    node, got = component(vehicle)
    nodes = [node]

    def poll(armed=True):
        nodes[-1].on_rates_thrust(RatesThrust(0, armed, STILL, 9.81))
        nodes[-1].on_poll(time.monotonic_ns())

    def flown(seconds):
        begin = time.monotonic()
        with suppress(AssertionError):
            until(lambda: False, seconds, poll)
        return min(min(motors) for moment, motors in vehicle.history if moment >= begin)

    try:
        poll(False)
        until(lambda: min(vehicle.motors) > 0.6, often=poll)
        until(lambda: got["diagnostics"] and got["diagnostics"][-1].values.get("armed"), often=poll)  # its state is known
        node._link.process.kill()
        assert flown(1.5) > 0.6
        assert "the process that holds the link has ended: it is restarted" in {line.text for line in got["log"]}
        node._link.process.kill()                                                 # and the node with it
        nodes.append(component(vehicle)[0])
        assert flown(1.5) > 0.6
        nodes[-1]._link.process.kill()                                            # and again, and no command follows
        last = time.monotonic()
        until(lambda: not vehicle.turning, often=lambda: nodes[-1].on_poll(time.monotonic_ns()))
        assert 4.0 < time.monotonic() - last < 8.0
    finally:
        for one in nodes:
            one.close()


@pytest.mark.parametrize("switched", [True, False])
def test_preflight_sees_whether_the_pilot_takes_over(vehicle, switched):
    """The node and the firmware, without the graph between them and preflight."""
    node, got = component(vehicle)
    listener = object.__new__(GraphListener)
    listener.values, listener._namespace = {channel: [] for channel in CHANNELS}, ""

    def work():
        node.on_rates_thrust(order := RatesThrust(0, True, STILL, 9.81))
        node.on_poll(time.monotonic_ns())
        listener.values["rates_thrust_command"].append((time.monotonic(), order))
        told = listener.values["/diagnostics"]
        told += [(time.monotonic(), said) for said in got["diagnostics"][len(told):]]
        if switched and told and told[-1][1].values.get("armed"):
            vehicle.radio[6], vehicle.radio[4] = OFF, OFF

    def spin_for(duration):
        """At first, until the node has said that the motors turn, however late that comes."""
        end, told = time.monotonic() + duration, listener.values["/diagnostics"]
        until(lambda: time.monotonic() > end and any(said.values.get("armed") for _, said in told), often=work)

    listener.spin_for = spin_for
    try:
        node.on_rates_thrust(RatesThrust(0, False, STILL, 9.81))
        assert listener.await_takeover(10.0 if switched else 4.0) == (True, True if switched else None)
        assert vehicle.turning is not switched
    finally:
        node.close()


def test_why_it_does_not_arm_is_said(vehicle):
    vehicle.radio[2], vehicle.radio[6] = 1500, OFF  # the pilot has not handed over, and has his throttle up
    node, got = component(vehicle)
    try:
        def poll():
            node.on_rates_thrust(RatesThrust(0, True, STILL, 9.81))
            node.on_poll(time.monotonic_ns())

        until(lambda: any("refuses to arm: throttle is not low" in line.text for line in got["log"]), often=poll)
        assert not vehicle.turning
    finally:
        node.close()


def answered(running, *requests: bytes) -> list[msp.Frame]:
    """Answers of a firmware in the loop over MSP. It gives them between cycles: none passes meanwhile, however late they come."""
    parser, frames, last = msp.Parser(), [], time.monotonic() + 120.0
    running.send(b"".join(requests))
    while len(frames) < len(requests):
        assert time.monotonic() < last, "it does not answer"
        frames += parser.feed(running.receive(1.0))
    return frames


def refusals(running, radio=(1500, 1500, 1000, 1500, OFF), orders=(), cycles=100) -> tuple[str, ...]:
    """Why a firmware in the loop does not arm some cycles after orders over MSP, with a radio, pulse widths [us]."""
    assert not any(frame.refused for frame in answered(running, *(msp.request(*order) for order in orders)))
    for _ in range(cycles):
        running.step(STILL, GRAVITY, LEVEL, radio)
    return msp.status(*answered(running, msp.request(msp.STATUS))).refusals


def test_reasons_not_to_arm_that_can_be_provoked_are_named():
    """In 4.6.0: MSP_SET_MODE_RANGE is 35, MSP_ACC_CALIBRATION 205; box 27 is FAILSAFE, 36 PREARM."""
    def switched(box: int) -> tuple[int, bytes]:
        return 35, bytes((5, box, 3, 32, 48))  # mode range 5: this box by AUX4 above 1700

    running, low, high = started(lambda: Sitl(load_configuration("betaflight"))), (1500, 1500, 1000, 1500), (1500, 1500, 1500, 1500)
    aux4 = (*low, OFF, OFF, OFF, ON)
    throttle, radio = "throttle is not low: pull it down", "no radio signal (RX_FAILSAFE): switch the radio on, check the receiver"
    try:
        assert refusals(running, cycles=1) == (radio,)
        assert refusals(running, cycles=300) == ()
        assert refusals(running, (*high, OFF)) == (throttle,)
        assert refusals(running, (*high, ON)) == (throttle, msp.TOO_EARLY)
        assert refusals(running, (*low, ON)) == (msp.TOO_EARLY,)
        assert refusals(running) == ()
        assert refusals(running, orders=[switched(36)]) == ("no pre-arm: switch it on",)
        assert refusals(running, aux4) == ()
        assert refusals(running, aux4, [switched(27)]) == (radio, "box failsafe switch: switch it off")
        assert refusals(running, orders=[(205, b"")], cycles=1)[-1] == "calibrating: keep the vehicle still"
    finally:
        running.close()


def test_samples_and_attitude_come_in_the_axes_that_are_read():
    """Angular velocity in FLU; roll, pitch, heading of FRD in NED, against scipy's."""
    running = started(lambda: Sitl(load_configuration("betaflight")))
    rng, turned = np.random.default_rng(2), Rotation.from_euler("x", 180.0, degrees=True)
    try:
        for _ in range(300):
            running.step(STILL, GRAVITY, LEVEL, (1500, 1500, 1000, 1500))
        for _ in range(6):
            R = Rotation.from_euler("ZYX", rng.uniform((-170, -70, -170), (170, 70, 170)), degrees=True)
            gyro, force, q = rng.uniform(-2.0, 2.0, 3), R.inv().apply(GRAVITY), R.as_quat()[[3, 0, 1, 2]]
            for _ in range(500):
                running.step(gyro, force, q, (1500, 1500, 1000, 1500))
            inertial, attitude = answered(running, msp.request(msp.RAW_IMU), msp.request(msp.ATTITUDE))
            felt, rate = msp.inertial(inertial, 256.0)
            assert rate == pytest.approx(gyro, abs=0.01) and felt @ force > 0.9 * GRAVITY[2]**2  # its accelerometer is filtered
            roll, pitch, heading = np.degrees(msp.attitude(attitude))
            true = (turned * R * turned.inv()).as_euler("ZYX", degrees=True)  # heading, pitch, roll; whole degrees of heading are told
            assert (roll, pitch) == pytest.approx(true[:0:-1], abs=0.2) and abs((heading - true[0] + 180.0) % 360.0 - 180.0) < 1.1
    finally:
        running.close()


def test_an_autopilot_that_does_not_answer_is_refused():
    import socket
    ours, theirs = socket.socketpair()
    theirs.send(b"\x00\xff\x13garbage")
    with pytest.raises(msp.MspError, match="no autopilot answers .* bytes received that are not MSP: is the baud rate right"):
        Betaflight(BetaflightParameters(link=f"fd:{ours.fileno()}"))
    ours.close()
    theirs.close()


# -- commands that stop, and the pilot: the supervisor, MSP, the firmware and a body in simulated time ------------------------

@pytest.fixture
def body():
    one = started(lambda: Body(VEHICLE))
    one.hover()
    yield one
    one.loop.close()


@pytest.mark.parametrize("axis, tilt, rate", [
    ((1, 0, 0), 30.0, 2.0), ((-1, 0, 0), 60.0, 4.0), ((0, 1, 0), 60.0, 4.0), ((0, -1, 0), 90.0, 0.0), ((0.6, 0.8, 0), 45.0, 2.0),
    ((0, 1, 0), 85.0, 6.5), ((0.6, 0.8, 0), 60.0, 4.0)])
def test_a_body_is_level_a_third_of_a_second_after_the_last_command(body, axis, tilt, rate):
    body.found(axis, tilt, rate)
    last, told, above = body.loop.last_command, None, 0.0
    body.loop.kill()
    while body.time < last + 1.0:
        body.step(True, (5.0, 0.0, 0.0))
        if told is None and body.loop.watchdog.mode is not Mode.FOLLOWING:
            told = body.time - last
        above = body.time - last if body.tilt > 10.0 else above
    assert told <= 0.05 and above <= 0.3, (told, above)
    assert body.loop.watchdog.mode is Mode.DESCENDING and body.plant.v[2] < 0.0 and body.tilt < 3.0


def test_a_link_that_is_cut_is_followed_again_when_it_is_back(body):
    """However long it was cut, and each time."""
    for gap in (0.05, 0.2, 1.0, 3.0):
        last, body.loop.cut, modes = body.loop.last_command, True, []
        while body.time < last + gap:
            body.step(True)
            modes.append((body.time - last, body.loop.watchdog.mode))
        assert all((mode is Mode.FOLLOWING) == (age <= 0.04) for age, mode in modes if not 0.038 <= age <= 0.048)
        body.loop.cut = False
        for _ in range(10):
            body.step(True)
        assert body.loop.watchdog.mode is Mode.FOLLOWING
        for _ in range(90):
            body.step(True)
        assert body.tilt < 3.0


def test_without_commands_motors_are_off_after_four_seconds_and_stay_so(body):
    last, body.loop.cut = body.loop.last_command, True
    while body.loop.aimed.any():
        body.step(True)
        assert body.time < last + 4.1
    assert body.time > last + 4.0
    body.loop.cut = False
    for _ in range(300):
        body.step(True)
        assert not body.loop.aimed.any()  # only a command to disarm lets the next one arm


def test_a_controller_that_is_started_again_in_flight_does_not_stop_the_motors(body):
    """Its commands have the motors off: the descent ends first, and then it arms again."""
    last, body.loop.cut = body.loop.last_command, True
    while body.time < last + 1.0:
        body.step(True)
    body.loop.cut = False
    while body.time < last + 3.95:
        body.step(False)
        assert body.loop.aimed.min() > 0.8 * np.sqrt(VEHICLE.hover_thrust / 4.0 / VEHICLE.thrust_coefficient)
    assert body.loop.watchdog.mode is Mode.DESCENDING and body.tilt < 3.0
    while body.time < last + 4.2:
        body.step(False)
    assert not body.loop.aimed.any()
    for _ in range(300):
        body.step(True)
    assert body.loop.watchdog.mode is Mode.FOLLOWING and body.loop.aimed.all()


@pytest.mark.parametrize("tilt", [0.0, 60.0])
def test_the_pilot_has_the_vehicle_within_50_ms_of_his_switch(body, tilt):
    body.found((0, 1, 0), tilt, 4.0 if tilt else 0.0)
    body.loop.radio[4], body.loop.radio[6], begin = OFF, OFF, body.time
    while body.loop.aimed.any():
        body.step(True, (0.0, 4.0, 0.0))
        assert body.time - begin <= 0.05
    body.loop.radio[4] = ON                                     # armed by the pilot, his throttle down
    for _ in range(50):
        body.step(False)                                        # whatever the companion says
    assert VEHICLE.speed_min <= body.loop.aimed.min() and body.loop.aimed.mean() < 1.2 * VEHICLE.speed_min


# -- what is the firmware's own ------------------------------------------------------------------------------------------

def test_a_firmware_whose_wire_is_cut_holds_the_last_command(body):
    """Why docs/howto/real_vehicle.md sends the pilot: its failsafe knows the age of the radio's frames, not of those by MSP."""
    body.found((1, 0, 0), 0.0, 2.0)
    last, body.loop.severed = body.time, True
    while body.time < last + 1.0:
        body.step(True)
        assert body.plant.w[0] == pytest.approx(2.0, abs=0.2)


def test_a_receiver_by_msp_alone_levels_and_descends_when_the_wire_is_cut(monkeypatch):
    """The alternative of docs/howto/real_vehicle.md, without a pilot's radio: its failsafe counts the frames by MSP."""
    loaded = load_configuration("betaflight")
    lines = (*loaded.lines, "set failsafe_delay = 1", "set failsafe_procedure = AUTO-LAND", "set failsafe_throttle = 1560")

    def bench(loop, switch, _):
        for _ in range(500):
            answered(loop.sitl, msp.channels((*CENTRED, switch, OFF)))
            motors = loop.sitl.step(STILL, GRAVITY, LEVEL, CENTRED)
            if min(motors) > 0.02 if switch == ON else max(motors) == 0.0:
                return
        raise AssertionError(loop.sitl.status())

    monkeypatch.setattr("perch_autopilot.loop.load_configuration", lambda _: replace(loaded, lines=lines))
    monkeypatch.setattr(FirmwareLoop, "_bench", bench)
    monkeypatch.setattr(sitl, "STICKS", 9)  # nobody is there: frames by UDP would make that the receiver
    body = started(lambda: Body(VEHICLE))
    try:
        body.hover()
        body.found((1, 0, 0), 0.0, 2.0)
        last, body.loop.severed, held, above = body.time, True, 0.0, 0.0
        while body.time < last + 1.0:
            body.step(True)
            held = body.time - last if body.plant.w[0] > 1.5 else held
            above = body.time - last if body.tilt > 10.0 else above
        assert 0.1 < held < 0.2 and above < 0.35, (held, above)
        assert body.tilt < 3.0 and body.plant.v[2] < -0.5 and body.loop.aimed.min() > 0.0
    finally:
        body.loop.close()


@pytest.mark.parametrize("battery, share", [(Battery(), 0.85**2), (Battery(reference=16.0, range=(12.0, 17.0)), 1.0)])
def test_the_thrust_stays_where_the_throttle_follows_the_battery(battery, share):
    vehicle = replace(VEHICLE, actuation=replace(VEHICLE.actuation, battery=battery))
    loop, level, got = started(lambda: FirmwareLoop(vehicle, 0.85)), np.r_[np.zeros(6), 1.0, np.zeros(6)], []
    try:
        for k in range(300):
            loop.command(0, True, STILL, 9.81)
            got.append(vehicle.thrust_coefficient * np.sum(loop.speeds(0, level, np.zeros(4), Reading(STILL))**2) / vehicle.mass)
    finally:
        loop.close()
    assert got[-1] == pytest.approx(9.81 * share, rel=0.02)
