"""What is said to autopilots: MSP, sticks, axes, the watchdog, the configuration. No firmware is needed here."""

from __future__ import annotations

import errno
import os
import pty
import select
import socket
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perch_autopilot import firmware, frames, levelling, msp, sitl
from perch_autopilot.betaflight import Betaflight, BetaflightParameters
from perch_autopilot.configuration import Cli, CliError, Configuration, differences, load_configuration
from perch_autopilot.loop import FirmwareLoop
from perch_autopilot.mavlink import Mavlink, MavlinkParameters
from perch_autopilot.supervised_link import SupervisedLink
from perch_autopilot.rate_curve import RateCurve
from perch_autopilot.rates import Sticks, rate_curves
from perch_autopilot.watchdog import CENTRED, OFF, ON, Mode, Watchdog
from perch_autopilot.link import LinkError
from perch_core.config import config_dir
from perch_core.errors import ConfigError
from perch_core.values import NANOSECONDS, Command, ControllerCommand, RatesThrust
from perch_core.vehicle import Battery, load_vehicle
from scipy.spatial.transform import Rotation

VEHICLE = load_vehicle("betaflight")
VECTORS = st.lists(st.floats(-50, 50), min_size=3, max_size=3).map(np.array)
ROTATIONS = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3).map(Rotation.from_quat)


def answer(command: int, payload: bytes, direction: bytes = b">") -> bytes:
    """A frame as the firmware sends it, its checksum computed apart from the code under test."""
    body = bytes((len(payload), command)) + payload
    return b"$M" + direction + body + bytes((int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8))),))


# -- MSP -------------------------------------------------------------------------------------------------------------

@given(payloads=st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=60), st.booleans()), max_size=5),
       noise=st.lists(st.binary(max_size=9), min_size=5, max_size=5),
       cuts=st.lists(st.integers(1, 40), min_size=1, max_size=20))
@settings(max_examples=100, deadline=None)
def test_frames_are_found_in_whatever_pieces_and_between_noise(payloads, noise, cuts):
    noise = [piece.replace(b"$", b"#") for piece in noise]
    stream = b"".join(piece + answer(command, payload, b"!" if refused else b">") for piece, (command, payload, refused) in zip(noise, payloads))
    parser, found, at = msp.Parser(), [], 0
    while at < len(stream):
        size = cuts[at % len(cuts)]
        found += parser.feed(stream[at:at + size])
        at += size
    assert [(frame.command, frame.payload, frame.refused) for frame in found] == payloads and parser.checksum_errors == 0


def test_a_torn_frame_is_counted_and_the_next_one_is_found():
    whole = answer(msp.ANALOG, b"\x7b\x01\x02\x03\x04\x05\x06")
    torn = bytearray(whole)
    torn[7] ^= 0x40
    parser = msp.Parser()
    found = parser.feed(bytes(torn) + whole)
    assert [frame.command for frame in found] == [msp.ANALOG] and parser.checksum_errors == 1


@given(st.binary(max_size=300))
def test_any_bytes_leave_the_parser_ready(data):
    parser = msp.Parser()
    parser.feed(data + bytes(300))  # zeros complete or break whatever had begun
    assert [frame.command for frame in parser.feed(answer(1, b"x"))][-1:] == [1]


@pytest.mark.parametrize("variant, number, words", [
    (b"INAV", (7, 1, 0), "INAV 7.1.0"), (b"BTFL", (4, 2, 9), "BTFL 4.2.9"), (b"BTFL", (26, 6, 0), "BTFL 26.6.0")])
def test_another_firmware_is_refused_by_name(variant, number, words):
    with pytest.raises(msp.MspError, match=words):
        msp.version(msp.Frame(msp.FC_VARIANT, variant, False), msp.Frame(msp.FC_VERSION, bytes(number), False))


def test_every_reason_not_to_arm_is_named():
    known = {0: "gyro", 7: "throttle", 8: "tilted", 12: "calibrating", 13: "CLI", 16: "MSP", 18: "GPS",
             21: "reboot", 24: "protocol", 27: "position"}
    assert len(msp.ARMING_REASONS) == 28  # runtime_config.h of 4.6.0
    assert all(word in msp.ARMING_REASONS[bit] for bit, word in known.items())
    for count in (27, 29):  # 4.4 and 4.6
        for bit in range(count):
            payload = struct.pack("<HHHIBHBBBBIB", 0, 0, 0, 0, 0, 0, 3, 0, 0, count, 1 << bit, 0)
            refusal, = msp.status(msp.Frame(msp.STATUS, payload, False)).refusals
            assert refusal == (msp.TOO_EARLY if bit == count - 1 else msp.ARMING_REASONS[bit])


def test_reasons_not_to_arm_that_last_are_those_of_repairs_settings_and_restarts():
    def lasting(flags: int) -> tuple[str, ...]:
        return msp.status(msp.Frame(msp.STATUS, struct.pack("<HHHIBHBBBBIB", *(0,) * 8, 0, 29, flags, 0), False)).lasting

    words = lasting(0xFFFFFFFF)
    assert [word.split(":")[0] for word in words] == [
        "no gyro", "CLI is open", "paralyzed", "reboot required", "DSHOT bitbang", "accelerometer is not calibrated", "motor protocol is not set"]
    assert lasting(1 << 7 | 1 << 12 | 1 << 28) == ()


def test_short_and_refused_answers_are_typed_errors():
    for read in (msp.status, msp.battery, msp.attitude, lambda frame: msp.inertial(frame, 512.0)):
        for frame, words in ((msp.Frame(1, b"\x01", False), "^MSP 1: 1 bytes, needs "), (msp.Frame(1, bytes(40), True), "^MSP 1: refused$")):
            with pytest.raises(msp.MspError, match=words):
                read(frame)


def test_channels_are_a_request_with_their_pulse_widths():
    data = msp.channels((1500, 1600, 1000, 1400, 1900))
    assert data == b"$M<" + answer(msp.SET_RAW_RC, struct.pack("<5H", 1500, 1600, 1000, 1400, 1900))[3:]


# -- sticks ----------------------------------------------------------------------------------------------------------

@given(centre=st.floats(10, 1500), more=st.floats(0, 1000), expo=st.floats(0, 1), share=st.floats(-1, 1))
def test_the_rate_curve_is_inverted(centre, more, expo, share):
    curve = RateCurve(centre, centre + more, expo)
    wanted = share * curve.rate(1.0)
    assert curve.rate(curve.stick(wanted)) == pytest.approx(wanted, abs=0.003 * (centre + 6 * more) + 1e-6)


@given(centre=st.floats(10, 1500), more=st.floats(0, 1000), expo=st.floats(0, 1), stick=st.floats(-1, 1))
def test_the_rate_curve_is_that_of_the_firmware(centre, more, expo, stick):
    """As `applyActualRates` of Betaflight 4.6 computes it: expof = |s| (s^5 e + s (1 - e)), rate = s c + max(0, m - c) expof."""
    expof = abs(stick) * (np.power(stick, 5) * expo + stick * (1.0 - expo))
    assert RateCurve(centre, centre + more, expo).rate(stick) == pytest.approx(stick * centre + max(0.0, more) * expof, abs=1e-9 * centre)


def test_sticks_have_the_directions_of_a_pilot():
    sticks = Sticks(VEHICLE, rate_curves(load_configuration("betaflight").settings, ""))
    centre = sticks.channels((0.0, 0.0, 0.0), 9.81)
    roll_right, nose_down, nose_left = (sticks.channels(tuple(np.eye(3)[k]), 9.81) for k in range(3))
    assert centre[0] == centre[1] == centre[3] == 1500 and 1000 < centre[2] < 2000
    assert roll_right[0] > 1500 and nose_down[1] > 1500 and nose_left[3] < 1500


@given(st.floats(0.5, 17.0))
def test_throttle_gives_the_thrust(thrust):
    share = Sticks(VEHICLE, (RateCurve(400, 900, 0),) * 3).throttle(thrust)
    speed = VEHICLE.speed_min + share * (VEHICLE.speed_max - VEHICLE.speed_min)
    least, most = (4 * VEHICLE.thrust_coefficient * limit**2 for limit in (VEHICLE.speed_min, VEHICLE.speed_max))
    assert 4 * VEHICLE.thrust_coefficient * speed**2 == pytest.approx(min(max(thrust * VEHICLE.mass, least), most))


@given(thrust=st.floats(5.0, 11.0), voltage=st.floats(13.0, 17.0), exponent=st.floats(0.5, 3.0))
def test_the_throttle_follows_the_battery(thrust, voltage, exponent):
    battery = Battery(reference=16.0, exponent=exponent, range=(13.6, 16.8))
    sticks = Sticks(replace(VEHICLE, actuation=replace(VEHICLE.actuation, battery=battery)), (RateCurve(400, 900, 0),) * 3)
    full = sticks.throttle(thrust)
    sticks.set_voltage(voltage)
    share = (min(max(voltage, 13.6), 16.8) / 16.0) ** exponent  # of the thrust at the same throttle
    throttle = sticks.throttle(thrust * share)
    assert 0.0 < throttle < 1.0 and throttle == pytest.approx(full)
    assert sticks.covers_voltage(voltage) == (13.6 <= voltage <= 16.8)
    sticks.set_voltage(0.0)
    assert sticks.throttle(thrust * share) == throttle


def status_of(armed: bool) -> bytes:
    """Payload of a STATUS of an autopilot without reasons not to arm."""
    return struct.pack("<HHHIBHBBBBIB", 0, 0, 0, armed, *(0,) * 5, 29, 0, 0)


class StubAutopilot:
    """In the place of link and supervisor: an autopilot that answers with its version and its battery's voltage."""

    voltage, silent, armed, opened = 16.0, False, False, 0

    def __init__(self, address, hover, descent, disarm_after, curves) -> None:
        StubAutopilot.opened += 1
        self.throttles, self._said, self._parser, self.closed = (hover, descent), b"", msp.Parser(), False
        self.mode: list[str] = []
        self.ended, self.told = False, []

    def request(self, data: bytes) -> None:
        known = {msp.FC_VARIANT: b"BTFL", msp.FC_VERSION: bytes((4, 6, 0)),
                 msp.ANALOG: struct.pack("<BHHhH", 0, 0, 0, 0, round(100 * StubAutopilot.voltage)),
                 msp.RAW_IMU: struct.pack("<9h", 0, 0, 2048, *(0,) * 6),
                 msp.STATUS: status_of(self.armed)}
        if self.silent:
            return
        for frame in self._parser.feed(data.replace(b"$M<", b"$M>")):  # requests have the form of answers
            self._said += answer(frame.command, known[frame.command]) if frame.command in known else b""

    def receive(self, timeout: float = 0.0):
        if self.ended:
            raise LinkError("the process that holds the link has ended")
        (said, mode), self._said, self.mode = (self._said, self.mode), b"", []
        return said, mode

    def command(self, armed: bool, sticks) -> None:
        self.mode = ["following"]
        self.told.append((armed, sticks))

    def report_motors_turning(self) -> None:
        self.told.append("turning")

    def kill(self) -> None:
        self.told.append("kill")

    def set_throttles(self, hover: int, descent: int) -> None:
        self.throttles = hover, descent

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def flown_on(tmp_path, monkeypatch):
    """The node of a vehicle with a battery curve, on a desk with a voltage."""
    monkeypatch.setattr("perch_autopilot.betaflight.SupervisedLink", StubAutopilot)
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nextends: betaflight\nactuation:\n  type: rates_and_thrust\n"
                    "  battery: {reference: 16.0, exponent: 1.8, range: [13.6, 16.8]}\n")

    def make(voltage: float) -> Betaflight:
        """A node whose controller has begun with the motors off."""
        monkeypatch.setattr(StubAutopilot, "voltage", voltage)
        node = Betaflight(BetaflightParameters(vehicle=str(file)))
        node.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
        node._link.told.clear()
        return node

    return make


@pytest.mark.parametrize("voltage", [0.0, 12.1, 22.0])
def test_a_battery_without_a_thrust_curve_is_refused(voltage, flown_on):
    with pytest.raises(msp.MspError, match=f"the battery has {voltage:g} V: the thrust curve of .*mine.yaml .* 13.6 to 16.8 V"):
        flown_on(voltage)


def test_hover_and_descent_without_commands_follow_the_battery(flown_on, monkeypatch):
    node = flown_on(16.0)
    full = node._link.throttles
    assert full[0] > full[1]
    monkeypatch.setattr(StubAutopilot, "voltage", 14.0)
    for k in range(60):
        node.on_poll(k * 10_000_000)
    empty = node._link.throttles
    assert all(now > then for now, then in zip(empty, full))
    dog = Watchdog(*full, arming=0.0)
    dog.command(1.0, True, (1500, 1500, 1500, 1500))
    dog.set_throttles(*empty)
    assert (dog.channels(1.1)[2], dog.channels(1.6)[2]) == empty


def polled(node: Betaflight, start: float, count: int, thrust: float | None = None) -> list[str]:
    """What a node says in so many polls, 100 a second from a time [s], with armed commands of a thrust or none: lines of its log, each once."""
    lines: list = []
    node.log.receivers.append(lines.append)
    for k in range(count):
        if thrust is not None:
            node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), thrust))
        node.on_poll(round(start * 1e9) + k * 10_000_000)
    node.log.receivers.remove(lines.append)
    return [text for text in dict.fromkeys(line.text for line in lines) if text != "autopilot: following"]


def test_a_pilot_who_has_not_handed_over_is_named_though_the_firmware_gives_no_reason(flown_on):
    said, = polled(flown_on(16.0), 100.0, 200, 9.81)
    assert said == "the autopilot refuses to arm: the pilot has not handed over: switch MSP OVERRIDE on"


NONSENSE = RatesThrust(0, False, (np.nan,) * 3, np.nan)


def test_a_command_with_the_motors_off_stops_them_whatever_else_it_says(flown_on):
    node = flown_on(16.0)
    node.on_rates_thrust(NONSENSE._replace(armed=True))
    assert node._link.told == []
    node.on_rates_thrust(NONSENSE)
    assert node._link.told == [(False, CENTRED)]
    loop = object.__new__(FirmwareLoop)
    loop.sticks, loop.watchdog = node._sticks, watchdog()
    loop.command(0, True, (0.0, 0.0, 0.0), 9.81)
    assert loop.watchdog.channels(0.0)[4] == ON
    loop.command(0, *NONSENSE[1:])
    assert loop.watchdog.channels(0.0)[4] == OFF


def test_who_disarms_the_autopilot_is_obeyed_until_the_commands_have_the_motors_off(flown_on, monkeypatch):
    """A restarted autopilot would arm by itself otherwise; of a report that is corrupt, and alone, nothing follows."""
    node = flown_on(16.0)
    monkeypatch.setattr(StubAutopilot, "armed", True)
    assert polled(node, 1.0, 100, 9.81) == []
    node._handle_frame(msp.Frame(msp.STATUS, struct.pack("<HHHIBHBBBBIB", *(0,) * 9, 29, 0, 0), False), 0)
    assert polled(node, 2.0, 100, 9.81) == [] and "kill" not in node._link.told
    monkeypatch.setattr(StubAutopilot, "armed", False)
    said, = polled(node, 3.0, 33, 9.81)
    assert said.startswith("the autopilot was disarmed by its pilot") and "kill" in node._link.told
    polled(node, 3.33, 300, 9.81)
    node._link.ended = True
    polled(node, 6.5, 1)
    assert node._link.told == ["kill"]                   # of the process that holds the link now
    monkeypatch.setattr(StubAutopilot, "armed", True)    # the pilot flies
    assert "the pilot must not hand over: its motors would stop until the controller has disarmed once" in polled(node, 6.6, 50, 9.81)
    monkeypatch.setattr(StubAutopilot, "armed", False)
    node.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
    node._link.told.clear()
    polled(node, 7.2, 100, 9.81)
    monkeypatch.setattr(StubAutopilot, "armed", True)
    polled(node, 8.3, 100, 9.81)
    assert "kill" not in node._link.told


def obeyed(node: Betaflight, armed: bool) -> bool:
    """Give a node a command; return whether its link is told that the motors are to turn."""
    node._link.told.clear()
    node.on_rates_thrust(RatesThrust(0, armed, (0.0, 0.0, 0.0), 9.81 * armed))
    return [word[0] for word in node._link.told if word != "kill"] == [True]


def test_kill_ends_with_a_command_with_the_motors_off_when_the_autopilot_has_been_disarmed(flown_on, monkeypatch):
    """Until then nobody knows whether it has arrived."""
    node = flown_on(16.0)
    monkeypatch.setattr(StubAutopilot, "armed", True)
    assert polled(node, 1.0, 100, 9.81) == []
    node.on_command(ControllerCommand(0, Command.KILL, "by hand"))
    assert not obeyed(node, False) and not obeyed(node, True)
    monkeypatch.setattr(StubAutopilot, "armed", False)
    polled(node, 2.0, 50)                                # the request came before it was disarmed
    assert not obeyed(node, True)
    assert not obeyed(node, False) and obeyed(node, True)
    node.on_command(ControllerCommand(0, Command.KILL, "by hand"))
    assert not obeyed(node, False)
    polled(node, 3.0, 50)
    assert node._link.told[-1] == (False, CENTRED) and obeyed(node, True)


def test_kill_is_sent_again_with_each_report_that_has_the_autopilot_armed(flown_on, monkeypatch):
    """Its frame may be lost, and no command follows that would repeat it."""
    node = flown_on(16.0)
    monkeypatch.setattr(StubAutopilot, "armed", True)
    assert polled(node, 1.0, 100, 9.81) == []
    node.on_command(ControllerCommand(0, Command.KILL, "by hand"))
    node._link.told.clear()
    polled(node, 2.0, 100)
    assert node._link.told.count("kill") >= 3 and set(node._link.told) == {"kill"}


@pytest.mark.parametrize("armed", [False, True])
def test_a_node_that_is_started_obeys_commands_to_arm_only_after_one_with_the_motors_off(armed, flown_on, monkeypatch):
    """A KILL before its start is not known; what flies is flown on."""
    file = flown_on(16.0).config.vehicle
    monkeypatch.setattr(StubAutopilot, "armed", armed)
    node = Betaflight(BetaflightParameters(vehicle=file))
    assert obeyed(node, True) is armed
    said = polled(node, 1.0, 200, 9.81)
    assert said == ([] if armed else ["the autopilot refuses to arm: this node was started: disarm first"])
    monkeypatch.setattr(StubAutopilot, "armed", True)    # by its pilot
    polled(node, 3.0, 50, 9.81)
    node._link.ended = True
    polled(node, 4.0, 1)
    assert bool([word for word in node._link.told if word not in ("kill", "turning")]) is armed
    assert obeyed(node, True) is armed
    assert not obeyed(node, False) and obeyed(node, True)


def test_a_disarm_and_an_arm_between_two_reports_arm(flown_on, monkeypatch):
    """The first report after them may be from before: that it is disarmed later is by the command."""
    node = flown_on(16.0)
    monkeypatch.setattr(StubAutopilot, "armed", True)
    assert polled(node, 1.0, 100, 9.81) == []
    assert not obeyed(node, False)
    for armed in (True, False, False, False):
        monkeypatch.setattr(StubAutopilot, "armed", armed)
        assert obeyed(node, True)
        node._handle_frame(msp.Frame(msp.STATUS, status_of(armed), False), 2 * NANOSECONDS)
    assert obeyed(node, True)
    monkeypatch.setattr(StubAutopilot, "armed", True)
    assert polled(node, 2.5, 100, 9.81) == []


def test_rotors_are_reported_to_stand_only_while_it_is_disarmed_and_no_command_has_them_on(flown_on, monkeypatch):
    node, reports = flown_on(16.0), []
    node.rotors.receivers.append(reports.append)

    def reported(start: float, **armed: float) -> list:
        """The reports after half a second of polls from a time [s]: the state is requested three times a second."""
        polled(node, start, 50, **armed)
        reports.clear()
        polled(node, start + 0.5, 100, **armed)
        return [(report.speed, report.thrust) for report in reports]

    standing = [((0.0,) * 4, (0.0,) * 4)] * 3
    assert reported(1.0) == standing
    assert reported(3.0, thrust=9.81) == []              # it may arm at any moment
    assert not obeyed(node, False) and reported(5.0) == standing
    monkeypatch.setattr(StubAutopilot, "armed", True)    # by its pilot
    assert reported(7.0) == []
    monkeypatch.setattr(StubAutopilot, "armed", False)
    assert reported(9.0) == standing
    monkeypatch.setattr(StubAutopilot, "silent", True)
    assert reported(11.0) == []
    monkeypatch.setattr(StubAutopilot, "silent", False)  # its pilot has armed it meanwhile; samples come before its state
    monkeypatch.setattr(StubAutopilot, "armed", True)
    polled(node, 13.0, 100)
    assert reports == []


def test_a_clock_that_jumps_is_one_line_and_everything_goes_on(flown_on):
    node, reports, samples = flown_on(16.0), [], []
    node.diagnostics.receivers.append(reports.append)
    node.imu.receivers.append(samples.append)
    assert polled(node, 5000.0, 100) == []
    for start, words in ((1400.0, "went back by 3600.990 s"), (9000.0, "went on by 7599.010 s"), (8999.5, "went back by 1.490 s")):
        before, taken = len(reports), len(samples)
        said, = polled(node, start, 100)
        assert words in said and len(reports) > before and len(samples) >= taken + 99
        assert {report.level for report in reports[before:]} == {0}


@pytest.mark.parametrize("armed, thrust", [(False, 9.81), (True, 9.81), (True, 0.0)])
def test_a_process_that_holds_the_link_and_ends_is_replaced(armed, thrust, flown_on, monkeypatch):
    """What flies keeps its throttle, and the new process is told of a hover, so that it descends where no command follows; what idles, idles."""
    node = flown_on(16.0)
    monkeypatch.setattr(StubAutopilot, "armed", armed)
    assert polled(node, 1.0, 50, thrust) == []
    last, opened = node._link, StubAutopilot.opened
    last.ended = True
    assert polled(node, 1.5, 10) == ["the process that holds the link has ended: it is restarted"]
    assert StubAutopilot.opened == opened + 1 and last.closed and not node._link.closed
    command = (True, node._sticks.channels((0.0, 0.0, 0.0), thrust))
    assert node._link.told == ([] if not armed else ["turning", command] if thrust else [command])
    for k in range(100):
        node._link.ended = True
        node.on_poll(round(1.6e9) + k * 10_000_000)
    assert StubAutopilot.opened == opened + 6  # five times a second


def test_of_samples_that_come_at_once_the_newest_counts(flown_on):
    """A torn length keeps the frames behind it back: they come together, and all but one are old."""
    node, samples = flown_on(16.0), []
    node.imu.receivers.append(samples.append)
    node._link._said = b"".join(answer(msp.RAW_IMU, struct.pack("<9h", 0, 0, 256 * k, *(0,) * 6)) for k in range(1, 9))
    node.on_poll(0)
    sample, = samples
    assert sample.f_B[2] == pytest.approx(9.81)


def test_torn_frames_in_flight_are_one_line_and_the_whole_ones_count(flown_on):
    node, samples, whole = flown_on(16.0), [], answer(msp.RAW_IMU, bytes(18))
    node.imu.receivers.append(samples.append)
    assert polled(node, 1.0, 100) == []
    node._link._said += whole[:-1] + bytes((whole[-1] ^ 0x55,))
    assert polled(node, 2.0, 150) == ["/dev/ttyACM0: corrupt frames received from the autopilot: check the link and its baud rate"]
    assert len(samples) > 240
    assert polled(node, 3.5, 150) == []


def test_an_autopilot_that_vanishes_is_one_line(flown_on, monkeypatch):
    node = flown_on(16.0)
    assert polled(node, 1.0, 100) == []
    monkeypatch.setattr(StubAutopilot, "silent", True)
    assert polled(node, 2.0, 400) == ["/dev/ttyACM0: the autopilot is silent: check its power and its link"]


@pytest.mark.parametrize("noise", [b"", b"\x00\xf8\x06\x9e" * 50])
def test_a_serial_line_that_answers_at_another_rate_is_refused_and_motors_stay_off(noise, monkeypatch):
    """What comes of another baud rate: bytes that are no MSP, or none. A pseudo-terminal has no rate of its own."""
    ours, theirs = pty.openpty()
    links: list[SupervisedLink] = []

    class Noisy(SupervisedLink):
        def __init__(self, *arguments) -> None:
            super().__init__(*arguments)
            links.append(self)
            os.write(ours, noise)
            assert not noise or select.select([self._control], [], [], 60.0)[0]  # it has been passed on

    monkeypatch.setattr("perch_autopilot.betaflight.SupervisedLink", Noisy)
    monkeypatch.setattr("perch_autopilot.betaflight._HANDSHAKE", 0.1)
    words = "bytes received that are not MSP: is the baud rate right" if noise else "no autopilot answers within 0.1 s$"
    with pytest.raises(msp.MspError, match=words) as error:
        Betaflight(BetaflightParameters(link=f"{os.ttyname(theirs)}@9600"))
    assert "\n" not in str(error.value) and links[0].process.wait(60.0) == 0
    heard = msp.Parser().feed(os.read(ours, 1 << 16).replace(b"$M<", b"$M>"))
    assert heard and msp.SET_RAW_RC not in {frame.command for frame in heard}
    os.close(theirs)
    os.close(ours)


# -- axes ------------------------------------------------------------------------------------------------------------

NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FRD = Rotation.from_matrix(np.diag([1, -1, -1]))


@given(VECTORS, ROTATIONS)
def test_changes_of_axes_agree_with_scipy_and_are_their_own_inverse(v, R):
    assert frames.world(v) == pytest.approx(NED.apply(v)) and frames.body(v) == pytest.approx(FRD.apply(v))
    q = frames.attitude(R.as_quat())
    assert (NED * R * FRD.inv() * Rotation.from_quat(q).inv()).magnitude() < 1e-6 and q[3] >= 0.0
    assert (Rotation.from_quat(frames.attitude(q)) * R.inv()).magnitude() < 1e-6
    for axes, name in ((NED.as_matrix(), frames.WORLD), (FRD.as_matrix(), frames.BODY)):
        x = np.r_[v, 2 * v + 1.0]
        turned = np.r_[axes @ x[:3], axes @ x[3:]]
        assert frames.covariance(np.outer(x, x), name) == pytest.approx(np.outer(turned, turned))


# -- watchdog --------------------------------------------------------------------------------------------------------

STICKS = (1510, 1520, 1600, 1530)


def watchdog() -> Watchdog:
    """One that has been told to arm a second ago."""
    dog = Watchdog(hover=1450, descent=1420)
    dog.command(-1.0, True, STICKS)
    return dog


def test_it_arms_with_the_throttle_down():
    dog = Watchdog(hover=1450, descent=1420)
    dog.command(5.0, True, STICKS)
    assert dog.channels(5.03) == (1500, 1500, 1000, 1500, ON, OFF)
    dog.command(5.25, True, STICKS)
    assert dog.channels(5.25) == (*STICKS, ON, OFF)


def test_of_what_flies_already_the_throttle_does_not_come_down():
    dog = Watchdog(hover=1450, descent=1420)
    dog.report_motors_turning()
    assert not dog.command_received
    dog.command(5.0, True, STICKS)
    assert dog.command_received and dog.channels(5.0) == (*STICKS, ON, OFF)
    dog.command(5.1, False, STICKS)
    dog.command(5.2, True, STICKS)
    assert dog.channels(5.2) == (1500, 1500, 1000, 1500, ON, OFF)


def test_what_was_armed_before_the_first_command_is_taken_to_fly():
    dog = Watchdog(hover=1450, descent=1420)
    dog.report_motors_turning()
    dog.command(5.0, True, CENTRED)
    assert dog.channels(5.1)[2] == 1450


def test_a_fresh_command_goes_on_and_a_stale_one_never_does():
    dog = watchdog()
    dog.command(10.0, True, STICKS)
    ages = np.arange(0.0, 6.0, 0.004)
    sent = [dog.channels(10.0 + age) for age in ages]
    for age, channels in zip(ages, sent):
        assert (channels[:4] == STICKS) == (age <= 0.04)
        if 0.041 < age <= 0.3:
            assert channels[4:] == (ON, ON) and channels[:2] == (1500, 1500)  # levels within 0.3 s
        if 1.0 < age:
            assert channels[4] == OFF or channels[2] < 1450  # descends or is off within 1 s
    assert sent[-1][4] == OFF and sent[-1][2] == 1000


IDLE = (1502, 1540, 1002, 1498)  # rates follow the gyroscope, also in a hand


@pytest.mark.parametrize("sticks, lifted", [(IDLE, False), ((1500, 1500, 1300, 1500), True), ((1500, 1350, 1000, 1500), True)],
                         ids=["idle", "thrust", "turn"])
def test_where_no_command_since_arming_has_asked_for_lift_the_throttle_stays_down(sticks, lifted):
    """And the motors are off after half a second."""
    dog = Watchdog(hover=1450, descent=1420)
    for armed, last in ((True, STICKS), (False, STICKS), (True, IDLE), (True, sticks), (True, IDLE)):
        dog.command(0.0, armed, last)
    for age in (0.041, 0.49):
        assert dog.channels(age) == ((1500, 1500, 1450, 1500, ON, ON) if lifted else (1500, 1500, 1000, 1500, ON, OFF))
    assert dog.channels(0.51)[4] == (ON if lifted else OFF) and dog.channels(4.01)[4] == OFF
    dog.command(5.0, True, STICKS)
    assert dog.channels(5.0)[4] == OFF  # only a command to disarm lets the next one arm


def test_after_motors_were_taken_away_only_a_new_arming_turns_them_on():
    dog = watchdog()
    dog.command(0.0, True, STICKS)
    assert dog.channels(9.0)[4] == OFF
    dog.command(9.1, True, STICKS)
    assert dog.channels(9.1)[4] == OFF and dog.mode is Mode.DISARMED
    dog.command(9.2, False, STICKS)
    dog.command(9.3, True, STICKS)
    dog.command(9.6, True, STICKS)
    assert dog.channels(9.6) == (*STICKS, ON, OFF)


def test_a_link_that_comes_back_in_time_flies_on():
    dog = watchdog()
    dog.command(0.0, True, STICKS)
    assert dog.channels(0.6)[2] == 1420 and dog.mode is Mode.DESCENDING
    dog.command(0.7, True, STICKS)
    assert dog.channels(0.73) == (*STICKS, ON, OFF)


def test_a_controller_that_is_started_again_in_flight_does_not_stop_the_motors():
    dog = watchdog()
    dog.command(0.0, True, STICKS)
    assert dog.channels(0.6)[2] == 1420 and dog.mode is Mode.DESCENDING
    dog.command(1.0, False, CENTRED)
    assert dog.channels(1.0)[2] == 1420 and dog.channels(3.9)[4] == ON and dog.channels(4.1)[4] == OFF
    dog.command(4.2, False, CENTRED)                            # the descent has ended: it may arm again
    dog.command(4.3, True, STICKS)
    assert dog.channels(4.3)[4] == ON


@pytest.mark.parametrize("age", [0.01, 0.2, 1.0])
def test_kill_stops_the_motors_also_in_a_descent_without_commands(age):
    dog = watchdog()
    dog.command(0.0, True, STICKS)
    assert dog.channels(age)[4] == ON
    dog.kill()
    assert dog.channels(age)[4] == OFF
    dog.command(age + 0.1, True, STICKS)
    assert dog.channels(age + 0.1)[4] == OFF
    dog.command(age + 0.2, False, CENTRED)
    dog.command(age + 0.3, True, STICKS)
    assert dog.channels(age + 0.3)[4] == ON


@pytest.mark.parametrize("command, stamp, killed", [(5, 0, True), (5, 9 * NANOSECONDS, True), (5, NANOSECONDS, False), (3, 0, False)])
def test_the_node_itself_obeys_a_kill_that_is_current(command, stamp, killed, flown_on):
    node = flown_on(16.0)
    lines: list = []
    node.log.receivers.append(lines.append)
    node.on_poll(9 * NANOSECONDS + 1)
    node.on_command(ControllerCommand(stamp, command, "by hand"))
    assert ("kill" in node._link.told) is killed
    assert any("is too old: ignored" in line.text for line in lines) is (command == Command.KILL and not killed)


def test_a_clock_that_jumps_back_turns_the_motors_off():
    dog = watchdog()
    dog.command(100.0, True, STICKS)
    assert dog.channels(50.0)[4] == OFF


# -- levelling by rates --------------------------------------------------------------------------------------------------

CURVES = (RateCurve(400, 900, 0.0), RateCurve(400, 900, 0.3))


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@given(ROTATIONS)
def test_levelling_turns_up_the_shortest_way(R):
    """Against scipy: the rotation vector of the smallest rotation that takes z of B to up."""
    _, pitch, roll = (NED * R * FRD.inv()).as_euler("ZYX")
    up = levelling.up(roll, pitch)
    assert up == pytest.approx(R.inv().apply((0.0, 0.0, 1.0)), abs=1e-9)
    if abs(np.hypot(up[0], up[1])) < 1e-3:
        return
    rates = np.array((*levelling.rates(up, 100.0), 0.0))
    assert np.hypot(*levelling.rates(up, 3.0)) == pytest.approx(min(np.hypot(*rates[:2]), 3.0))
    turned = R * Rotation.from_rotvec(rates / levelling.GAIN)
    assert turned.apply((0.0, 0.0, 1.0)) == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)
    assert np.linalg.norm(rates) / levelling.GAIN == pytest.approx(levelling.tilt(up)) and levelling.tilt(up) <= np.pi


@given(ROTATIONS.map(lambda R: tuple(R.apply((0.0, 0.0, 1.0)))))
def test_the_sticks_ask_for_the_levelling_rate(up):
    widths = levelling.sticks(up, CURVES)
    asked = [np.radians(curve.rate((width - 1500) / 500)) for curve, width in zip(CURVES, widths)]
    assert asked == pytest.approx(levelling.rates(up, np.radians(900.0)), abs=0.06)


def test_far_from_level_rates_are_commanded_while_the_attitude_is_fresh_and_self_level_otherwise():
    dog = Watchdog(hover=1450, descent=1420, curves=CURVES)
    dog.command(-1.0, True, STICKS)
    dog.command(10.0, True, STICKS)
    assert [dog.needs_attitude(10.0 + age) for age in (0.01, 0.03, 1.0)] == [False, True, True]
    for age, throttle in ((0.05, 1450), (0.6, 1420)):
        dog.attitude(10.0 + age, 0.0, np.radians(-80.0))                          # nose down: up again
        roll, pitch, *rest = dog.channels(10.0 + age)
        assert (roll, rest) == (1500, [throttle, 1500, ON, OFF]) and pitch < 1500
        assert dog.channels(10.0 + age + 0.06) == (1500, 1500, throttle, 1500, ON, ON)   # its attitude is old
        dog.attitude(10.0 + age, 0.0, np.radians(-40.0))
        assert dog.channels(10.0 + age) == (1500, 1500, throttle, 1500, ON, ON)
    dog.attitude(14.1, 0.0, 1.5)
    assert dog.channels(14.1)[4] == OFF
    dog.command(15.0, False, STICKS)
    assert not dog.needs_attitude(16.0)


# -- configuration ---------------------------------------------------------------------------------------------------

def test_what_is_set_otherwise_is_named():
    wanted = ("feature AIRMODE", "set p_roll = 180", "aux 0 0 0 1700 2100 0 0")
    assert differences(wanted, ["feature AIRMODE", "set p_roll = 180", "aux 0 0 0 1700 2100 0 0", "set other = 1"]) == []
    assert differences(wanted, ["feature AIRMODE", "aux 0 0 0 1700 2100 0 0"]) == ["p_roll is unknown, not 180"]
    assert differences(wanted, ["feature AIRMODE", "set p_roll = 45"]) == ["p_roll is 45, not 180", "aux 0 0 0 1700 2100 0 0 is missing"]


@pytest.mark.parametrize("text, words", [("", "has no line"), ("rm -rf /", "is not one of"), ("set p_roll 5", "is not one of")])
def test_a_configuration_that_is_none_is_refused(tmp_path, text, words):
    file = tmp_path / "mine.txt"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_configuration(str(file))
    for name in ("none.txt", "no\0ne.txt"):
        with pytest.raises(ConfigError, match="cannot be read"):
            load_configuration(str(tmp_path / name))


@pytest.mark.parametrize("came, words", [(b"", "within 0 s$"), (b"\x00\xf8" * 40, "bytes received, the last .*: is the baud rate right")])
def test_a_command_line_that_does_not_answer_is_one_line(came, words, monkeypatch):
    monkeypatch.setattr("perch_autopilot.configuration._ANSWER_TIME", 0.0)
    with pytest.raises(CliError, match=words) as error:
        Cli(lambda data: None, lambda timeout: came)
    assert len(str(error.value)) < 160


@pytest.mark.parametrize("size", [1, 2, 3, 5, 64])
def test_a_dump_is_read_to_its_end_in_whatever_pieces_it_arrives(size):
    """Its comments begin like the prompt."""
    dump, pending = b"dump\r\n\r\n# version\r\n# feature\r\nset p_roll = 180\r\n\r\n# ", bytearray(b"#\r\n# ")

    def receive(_: float) -> bytes:
        piece = bytes(pending[:size])
        del pending[:size]
        return piece

    cli = Cli(lambda data: pending.extend(dump * data.startswith(b"dump")), receive)
    cli.check(Configuration("mine.txt", ("set p_roll = 180",)))
    assert not pending


@pytest.mark.parametrize("words", ["", "###ERROR IN set: VALUE OUT OF RANGE###", "INVALID NAME", "Unknown command, try 'help'"])
def test_a_line_that_the_firmware_refuses_ends_the_configuration_before_it_is_saved(words):
    sent, pending = [], bytearray()

    def send(data: bytes) -> None:
        sent.append(data)
        refused = words if data.startswith(b"set b") else ""
        pending.extend(data + f"\r\n{refused}\r\n# ".encode())

    def receive(_: float) -> bytes:
        piece = bytes(pending)
        pending.clear()
        return piece

    cli, mine = Cli(send, receive), Configuration("mine.txt", ("set a = 1", "set b = 9999", "set c = 2"))
    if words:
        with pytest.raises(CliError, match="^mine.txt: set b = 9999: the firmware refuses it: ") as error:
            cli.apply(mine)
        assert words.strip("#") in str(error.value)
    else:
        cli.apply(mine)
    cli.leave()
    assert sent[1:] == ([b"set a = 1\r\n", b"set b = 9999\r\n", b"exit\r\n"] if words else
                        [*(line.encode() + b"\r\n" for line in mine.lines), b"save\r\n"])


def test_a_firmware_in_the_loop_that_ends_is_named_at_once():
    ours, theirs = socket.socketpair()
    running = sitl.Sitl.__new__(sitl.Sitl)
    running._running = SimpleNamespace(stream=ours)
    with ours:
        assert running.receive(0.0) == running.receive(0.001) == b""
        theirs.close()
        with pytest.raises(firmware.FirmwareError, match="firmware has ended"):
            running.receive(60.0)
        with pytest.raises(firmware.FirmwareError, match="cannot be sent anything: Broken pipe"):
            running.send(b"#")


def test_a_copy_of_the_firmwares_memory_that_breaks_off_leaves_no_file(tmp_path, monkeypatch):
    def breaks_off(source, copy) -> None:
        copy.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sitl, "Cli", lambda *_: SimpleNamespace(apply=lambda _: None, check=lambda _: None))
    monkeypatch.setattr(sitl.Sitl, "_launch", lambda *_: None)
    monkeypatch.setattr(sitl.shutil, "copyfile", breaks_off)
    running = sitl.Sitl.__new__(sitl.Sitl)
    running._program, running._configuration = tmp_path / "betaflight_sitl", Configuration("mine.txt", ())
    running._running = SimpleNamespace(process=SimpleNamespace(wait=lambda _: 0), close=lambda: None)
    with pytest.raises(OSError, match="No space left"):
        running._configured(tmp_path / "draft")
    assert list(tmp_path.iterdir()) == []


def test_rates_of_another_type_are_refused():
    with pytest.raises(ConfigError, match="BETAFLIGHT is not ACTUAL"):
        rate_curves({"rates_type": "BETAFLIGHT"}, "x")
    with pytest.raises(ConfigError, match="roll_srate"):
        rate_curves({"rates_type": "ACTUAL", "roll_rc_rate": "40"}, "x")


@pytest.mark.parametrize("key, value, words", [
    ("roll_rc_rate", "abc", "abc is not a number"), ("roll_rc_rate", "nan", "nan is outside"), ("pitch_rc_rate", "0", "0 is outside"),
    ("yaw_rc_rate", "-7", "-7 is outside"), ("roll_srate", "39", r"39 is outside \[40, 199.8\]"), ("yaw_srate", "inf", "inf is outside"),
    ("pitch_expo", "500", r"500 is outside \[0, 100\]"), ("yaw_expo", "-1", "-1 is outside")])
def test_rates_that_the_firmware_cannot_have_are_refused_by_file_and_key(key, value, words):
    with pytest.raises(ConfigError, match=f"mine.txt: {key}: {words}"):
        rate_curves({**load_configuration("betaflight").settings, key: value}, "mine.txt")


def test_a_stick_for_no_rate_is_centred():
    assert [RateCurve(centre, centre, 0.0).stick(0.0) for centre in (0.0, 400.0)] == [0.0, 0.0]


@pytest.mark.parametrize("component, parameters", [(Betaflight, BetaflightParameters), (Mavlink, MavlinkParameters)])
def test_a_vehicle_that_takes_rotor_speeds_is_refused(component, parameters):
    pytest.importorskip("pymavlink", reason="pymavlink is an optional extra (scripts/setup.py --extra mavlink)")
    with pytest.raises(ConfigError, match="snapdragon: actuation.type: rotor_speeds: an autopilot takes rates_and_thrust"):
        component(parameters(vehicle="snapdragon", link="/dev/no_such_device"))


def test_the_firmware_that_is_built_is_the_one_that_is_locked():
    lock = (config_dir().resolve().parent / "requirements" / "autopilot.lock").read_text().splitlines()
    assert firmware.REQUIREMENT.split()[0] in lock
