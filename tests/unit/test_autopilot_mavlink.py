"""MAVLink: the way into offboard flight, clocks, and byte streams as an autopilot would send them. No autopilot is tried here."""

from __future__ import annotations

import itertools
import socket
from dataclasses import replace

import numpy as np
import pytest
from perch_autopilot.arming import Arming, Stop
from perch_autopilot.link import Link, LinkError
from perch_autopilot.mavlink import ClockOffset, Mavlink, MavlinkParameters
from perch_autopilot.offboard import ARDUPILOT, ARMED, GUIDED_NOGPS, OFFBOARD, PX4, Offboard, Request
from perch_core.component import Output, ports
from perch_core.values import NANOSECONDS, Command, ControllerCommand, OdometryState, RatesThrust
from perch_core.vehicle import load_vehicle

SECOND = NANOSECONDS


def asked(machine: Offboard, seconds: float, start: float = 0.0, wanted: bool = True, streaming: bool = True) -> list[Request]:
    """What a machine asks for in some time, at 100 Hz, but for nothing; the autopilot's heartbeats go on."""
    out = []
    for k in range(round(100 * seconds)):
        now = start + 0.01 * k
        if streaming:
            machine.arming.command(now, wanted)
        machine.heartbeat(now, machine.autopilot, ARMED * machine.armed, machine.mode if machine.following else 0)
        out.append(machine.next_request(now, wanted, streaming))
    return [request for request in out if request is not Request.NOTHING]


@pytest.mark.parametrize("autopilot, mode", [(PX4, OFFBOARD), (ARDUPILOT, GUIDED_NOGPS)])
def test_set_points_come_first_then_the_mode_then_the_motors(autopilot, mode):
    machine = Offboard(autopilot=autopilot)
    assert machine.mode == mode
    assert asked(machine, 0.4) == []                           # set points have to flow first
    assert asked(machine, 1.0, start=0.4) == [Request.MODE]
    machine.following = True
    assert asked(machine, 1.0, start=1.5) == [Request.ARM]
    machine.armed = True
    assert asked(machine, 1.0, start=2.5) == []
    assert asked(machine, 1.0, start=3.5, wanted=False) == [Request.DISARM]


def test_a_pilot_who_takes_the_mode_back_keeps_it():
    machine = Offboard(autopilot=PX4, armed=True, following=True)
    assert asked(machine, 2.0) == []
    machine.following = False
    assert asked(machine, 5.0, start=2.0) == []
    machine.armed = False
    assert asked(machine, 1.0, start=7.0, wanted=False) == []
    assert Request.MODE in asked(machine, 2.0, start=8.0)


@pytest.mark.parametrize("following", [True, False])
def test_who_disarms_the_autopilot_is_obeyed_until_the_commands_have_the_motors_off(following):
    machine = Offboard(autopilot=PX4, armed=True, following=True)
    assert asked(machine, 1.0) == []
    machine.armed, machine.following = False, following
    assert asked(machine, 5.0, start=1.0) == []
    asked(machine, 0.1, start=6.0, wanted=False)
    assert asked(machine, 1.5, start=6.1)[0] is (Request.ARM if following else Request.MODE)


def test_a_disarm_and_an_arm_between_two_heartbeats_arm():
    """The last heartbeat before them has it armed: that the next one has not is by the command."""
    machine = Offboard(autopilot=PX4, following=True)
    machine.heartbeat(0.0, PX4, ARMED, OFFBOARD)
    requests = []
    for k in range(300):
        now, wanted = 0.01 * k, not 110 <= k < 130
        if k % 100 == 0:
            machine.heartbeat(now, PX4, ARMED * (k < 200), OFFBOARD)
        machine.arming.command(now, wanted)
        requests.append((now, machine.next_request(now, wanted, True)))
    assert [(pytest.approx(now), request) for now, request in requests if request is not Request.NOTHING] == [
        (1.1, Request.DISARM), (2.1, Request.ARM)]


def test_a_pilot_who_disarms_right_after_the_controller_is_armed_is_obeyed():
    """The node has not requested that, though no heartbeat has come since commands have the motors on."""
    machine = Offboard(autopilot=PX4)
    requests = []
    for k in range(500):
        now, wanted = 0.01 * k, k >= 110
        if k % 100 == 0:
            machine.heartbeat(now, PX4, ARMED * (k < 150), OFFBOARD)
        machine.arming.command(now, wanted)
        obeyed = machine.obeys(wanted)
        requests.append(machine.next_request(now, wanted and obeyed, obeyed))
    assert set(requests) == {Request.NOTHING} and machine.arming.stop is Stop.AUTOPILOT


def test_kill_is_what_stops_the_motors_when_a_report_from_before_it_comes_late():
    arming = Arming()
    arming.command(0.0, True)
    arming.halt(Stop.KILL)
    arming.command(1.0, True)
    assert not arming.report(1.1, True) and not arming.report(2.1, False)
    assert arming.stop is Stop.KILL


@pytest.mark.parametrize("armed", [False, True])
def test_a_node_that_is_started_arms_only_after_a_command_with_the_motors_off(armed):
    """A KILL before its start is not known; what flies is flown on."""
    autopilot = Autopilot(armed=armed)
    m = autopilot.mavlink

    def sent(wanted: bool) -> set:
        kinds = set()
        for k in range(200):
            if k % 50 == 0:
                autopilot.say(m.heartbeat_encode(2, PX4, ARMED * armed, OFFBOARD, 4))
            autopilot.node.on_rates_thrust(RatesThrust(0, wanted, (0.0, 0.0, 0.0), 9.81))
            kinds |= set(autopilot.heard())
        return kinds & {"SET_ATTITUDE_TARGET", "COMMAND_LONG"}

    try:
        assert sent(True) == ({"SET_ATTITUDE_TARGET"} if armed else set())
        assert armed or "this node was started" in autopilot.got["log"][-1].text
        sent(False)
        assert sent(True) == ({"SET_ATTITUDE_TARGET"} if armed else {"SET_ATTITUDE_TARGET", "COMMAND_LONG"})
    finally:
        autopilot.node.close()
        autopilot.link.close()


def test_what_flies_already_is_asked_for_nothing():
    """A node that is started anew in flight: neither the pilot's mode, nor a vehicle that follows without set points, is its to change."""
    assert asked(Offboard(autopilot=PX4, armed=True), 5.0) == []
    following = Offboard(autopilot=PX4, armed=True, following=True)
    assert asked(following, 5.0, wanted=False, streaming=False) == [] == asked(following, 1.0, start=5.0, wanted=False, streaming=False)


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
def test_a_controller_that_is_started_again_in_flight_does_not_disarm(autopilot):
    machine = Offboard(autopilot=autopilot, armed=True, following=True)
    assert asked(machine, 1.0) == [] and machine.commanding
    assert asked(machine, 1.0, start=1.0, wanted=False, streaming=False) == [] and not machine.commanding
    assert asked(machine, 3.0, start=2.0, wanted=False) == []
    asked(machine, 0.1, start=5.0)                              # it commands the motors on: it is obeyed again
    assert asked(machine, 1.0, start=5.1, wanted=False) == [Request.DISARM]
    machine.commanding, machine.armed = False, False            # its failsafe has landed it
    asked(machine, 0.1, start=7.0, wanted=False)
    assert asked(machine, 1.5, start=7.1)[0] is Request.ARM


def test_nothing_is_asked_of_an_autopilot_that_is_gone_or_without_set_points():
    machine = Offboard()
    assert [machine.next_request(0.01 * k, True, True) for k in range(300)] == [Request.NOTHING] * 300
    assert asked(Offboard(autopilot=PX4), 3.0, streaming=False) == []


def test_the_clock_of_the_shortest_way_counts_and_a_jump_is_followed():
    clock, rng = ClockOffset(), np.random.default_rng(1)
    for k in range(50):
        sent, there, back = k * SECOND, *rng.uniform(1e5, 2e7, 2).astype(int).tolist()
        clock.answered(sent, sent + there - 7 * SECOND, sent + there + back)
    assert clock.offset == pytest.approx(7 * SECOND, abs=4e6)
    clock.answered(100 * SECOND, 900 * SECOND, 100 * SECOND + 1_000_000)
    assert clock.offset == pytest.approx(-800 * SECOND, abs=1e6)
    clock.answered(100 * SECOND, 0, 90 * SECOND)               # an answer before its request
    assert clock.offset == pytest.approx(-800 * SECOND, abs=1e6)


def test_an_exchange_of_long_ago_gives_way_to_slower_ones_as_clocks_drift():
    """By 50 ppm, 3 ms in a minute: an offset that only the fastest of all exchanges sets would be wrong by more and more."""
    clock = ClockOffset()
    clock.answered(0, 500_000, 1_000_000)                      # the fastest one, 1 ms there and back
    assert clock.offset == 0
    for k in range(1, 600):
        sent = k * SECOND
        drift = 50e-6 * sent
        clock.answered(sent, round(sent + 3_000_000 + drift), sent + 6_000_000)
        assert abs(clock.offset + drift) <= 5_000_000          # within the time after which an exchange has aged from 1 to 6 ms: 91 s
    assert clock.offset < -25_000_000


# -- byte streams ----------------------------------------------------------------------------------------------------

class Autopilot:
    """The other end of the link."""

    def __init__(self, kind: int = PX4, armed: bool = False) -> None:
        common = pytest.importorskip("pymavlink.dialects.v20.common", reason="pymavlink is an optional extra (scripts/setup.py --extra mavlink)")
        ours, self.link = socket.socketpair()
        self.mavlink = common.MAVLink(None, srcSystem=1, srcComponent=1)
        self.mavlink.robust_parsing = True
        self.say(self.mavlink.heartbeat_encode(2, kind, ARMED * armed, 0, 4))
        self.node = Mavlink(MavlinkParameters(link=f"fd:{ours.detach()}"))
        self.got: dict = {}
        for port in ports(Mavlink, Output):
            getattr(self.node, port.name).receivers.append(self.got.setdefault(port.name, []).append)
        self.now = SECOND

    def say(self, message) -> None:
        self.link.sendall(message.pack(self.mavlink))

    def command_disarmed(self) -> None:
        """Give the node commands with the motors off before its autopilot is armed."""
        self.heard()
        self.node.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
        self.heard()

    def heard(self, seconds: float = 0.005) -> dict:
        """What the node says while it is polled for a time, the last of each kind; requests of rates are one of their own."""
        for _ in range(max(round(seconds / 0.005), 1)):
            self.now += 5_000_000
            self.node.on_poll(self.now)
        self.link.setblocking(False)
        try:
            data = self.link.recv(1 << 20)
        except BlockingIOError:
            return {}
        finally:
            self.link.setblocking(True)
        return {"SET_MESSAGE_INTERVAL" if (kind := message.get_type()) == "COMMAND_LONG" and message.command == 511 else kind: message
                for message in self.mavlink.parse_buffer(data) or ()}


@pytest.fixture
def autopilot():
    one = Autopilot()
    one.command_disarmed()
    yield one
    one.node.close()
    one.link.close()


def test_rotors_are_reported_to_stand_only_while_it_is_disarmed_and_no_command_has_them_on(autopilot):
    def reported(armed: bool | None, wanted: bool) -> list:
        if armed is not None:
            autopilot.say(autopilot.mavlink.heartbeat_encode(2, PX4, ARMED * armed, 0, 4))
        autopilot.node.on_rates_thrust(RatesThrust(0, wanted, (0.0, 0.0, 0.0), 9.81 * wanted))
        autopilot.heard(0.01)
        autopilot.got["rotors"].clear()
        autopilot.heard(1.0)
        return [(report.speed, report.thrust) for report in autopilot.got["rotors"]]

    standing = [((0.0,) * 4, (0.0,) * 4)] * 10
    assert reported(False, False) == standing
    assert reported(False, True) == reported(True, True) == reported(True, False) == []
    assert reported(False, False) == standing
    reported(None, False)
    assert reported(None, False) == []                   # no heartbeat for two seconds


def test_commands_leave_in_the_axes_of_aviation_and_never_stale(autopilot):
    vehicle = load_vehicle("snapdragon_rates")
    autopilot.heard()
    autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.1, 0.2, 0.3), 9.81))
    target = autopilot.heard()["SET_ATTITUDE_TARGET"]
    assert (target.body_roll_rate, target.body_pitch_rate, target.body_yaw_rate) == pytest.approx((0.1, -0.2, -0.3))
    assert target.thrust == pytest.approx(vehicle.hover_thrust / (4 * vehicle.thrust_max)) and target.type_mask == 128
    assert "SET_ATTITUDE_TARGET" in autopilot.heard(0.05)
    autopilot.heard(0.1)
    assert "SET_ATTITUDE_TARGET" not in autopilot.heard(1.0)
    autopilot.node.on_rates_thrust(RatesThrust(0, True, (float("nan"), 0.0, 0.0), 9.81))
    assert "SET_ATTITUDE_TARGET" not in autopilot.heard() and "not finite" in autopilot.got["log"][-1].text
    autopilot.node.on_rates_thrust(RatesThrust(0, False, (float("nan"), 0.0, 0.0), float("nan")))
    assert autopilot.heard()["SET_ATTITUDE_TARGET"].thrust == 0.0


def test_a_command_is_not_held_for_ever_where_the_hosts_clock_stands_still(autopilot):
    """With `use_sim_time` and no /clock, the time of all polls is the same."""
    autopilot.say(autopilot.mavlink.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
    autopilot.heard()
    autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
    for _ in range(50):
        autopilot.node.on_poll(autopilot.now)
    sent = [message.get_type() for message in autopilot.mavlink.parse_buffer(autopilot.link.recv(1 << 20))]
    assert sent.count("SET_ATTITUDE_TARGET") == 20  # for 0.1 s


def test_odometry_leaves_as_ned_with_its_covariance(autopilot):
    P = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    autopilot.node.on_odometry(OdometryState(SECOND, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), (4.0, 5.0, 6.0), (0.1, 0.2, 0.3), P, P))
    said = autopilot.heard()["ODOMETRY"]
    assert (said.x, said.y, said.z, said.vx, said.vy, said.vz) == (2.0, 1.0, -3.0, 4.0, -5.0, -6.0)
    assert (said.frame_id, said.child_frame_id) == (20, 12)    # LOCAL_FRD, BODY_FRD: all that ArduPilot takes
    assert said.q == pytest.approx([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # forward is east: a heading of 90 deg, w x y z
    assert [said.pose_covariance[k] for k in (0, 6, 11, 15, 18, 20)] == [2.0, 1.0, 3.0, 5.0, 4.0, 6.0]


def test_odometry_has_the_hosts_time_and_says_what_it_lacks(autopilot):
    """The autopilot itself knows the host's clock against its own."""
    autopilot.say(autopilot.mavlink.timesync_encode(500 * SECOND, autopilot.now))
    autopilot.heard()
    P, unknown = np.eye(6), np.diag([-1.0, *(0.0,) * 5])

    def said(stamp, twist):
        autopilot.node.on_odometry(OdometryState(stamp, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, P, twist))
        return autopilot.heard()["ODOMETRY"]

    one, other = said(7 * SECOND, unknown), said(-5, np.zeros((6, 6)))
    assert (one.time_usec, other.time_usec) == (7_000_000, 0)
    assert np.isnan([one.vx, one.vy, one.vz, one.rollspeed, one.velocity_covariance[0], other.velocity_covariance[0]]).all()
    assert (other.vx, other.vy, other.vz) == (0.0, 0.0, 0.0) and one.pose_covariance[0] == 1.0


def test_odometry_is_sent_at_50_hz_also_after_its_time_has_gone_back(autopilot):
    P, m = np.eye(6), autopilot.mavlink
    for start in (100 * SECOND, 0):
        autopilot.heard()
        for k in range(500):
            autopilot.node.on_odometry(OdometryState(start + 2_000_000 * k, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, P, P))
        said = [message.time_usec for message in m.parse_buffer(autopilot.link.recv(1 << 20)) if message.get_type() == "ODOMETRY"]
        assert len(said) == 50 and set(np.diff(said)) == {20_000}


def test_imu_comes_in_by_the_hosts_clock_and_torn_frames_are_counted(autopilot):
    m = autopilot.mavlink
    imu = m.highres_imu_encode(5_000_000, 1.0, 2.0, -9.81, 0.1, 0.2, 0.3, 0, 0, 0, 0, 0, 0, 0, 63)
    autopilot.say(imu)
    autopilot.heard()
    assert autopilot.got["imu"] == []                          # its clock is unknown
    autopilot.say(m.timesync_encode(5 * SECOND, autopilot.now))
    torn = bytearray(imu.pack(m))
    torn[20] ^= 0xFF
    autopilot.link.sendall(bytes(torn))
    autopilot.say(imu)
    autopilot.heard()
    sample, = autopilot.got["imu"]
    assert sample.f_B == pytest.approx((1.0, -2.0, 9.81)) and sample.w_B == pytest.approx((0.1, -0.2, -0.3))
    assert sample.stamp == pytest.approx(autopilot.now, abs=10_000_000)
    autopilot.heard(1.1)
    assert autopilot.got["diagnostics"][-1].values["torn_frames"] >= 1


def test_ardupilot_gets_set_points_when_it_is_known_to_take_their_thrust():
    """GUID_OPTIONS, bit 3, and ATC_ANGLE_BOOST 0; else the thrust is a climb rate, or depends on the tilt."""
    autopilot = Autopilot(ARDUPILOT)
    m = autopilot.mavlink

    def second(options: float | None = None, boost: float | None = None) -> dict:
        """What the node says in a second, with commands, heartbeats and, where they are given, the parameters' values."""
        said: dict = {}
        autopilot.say(m.heartbeat_encode(2, ARDUPILOT, 0, 0, 4))
        if options is not None:
            autopilot.say(m.param_value_encode(b"GUID_OPTIONS", options, 6, 1, 0))
        if boost is not None:
            autopilot.say(m.param_value_encode(b"ATC_ANGLE_BOOST", boost, 2, 1, 0))
        for _ in range(200):
            autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
            said |= autopilot.heard()
        return said

    autopilot.command_disarmed()
    try:
        for options, boost in ((None, None), (0.0, None), (4.0, 0.0), (float("nan"), float("nan")), (9.0, 1.0)):
            said = second(options, boost)
            assert said["PARAM_REQUEST_READ"].param_id == "ATC_ANGLE_BOOST" and said["PARAM_REQUEST_READ"].param_index == -1
            assert not {"SET_ATTITUDE_TARGET", "COMMAND_LONG"} & set(said)
        report = autopilot.got["diagnostics"][-1]
        assert report.level == 2 and "GUID_OPTIONS needs bit 3 (value 8" in report.message
        second(9.0, 0.0)
        said = second()
        assert {"SET_ATTITUDE_TARGET", "COMMAND_LONG"} <= set(said) and "PARAM_REQUEST_READ" not in said
        assert autopilot.got["diagnostics"][-1].level == 0
    finally:
        autopilot.node.close()
        autopilot.link.close()


def test_it_arms_by_its_own_way_and_says_why_not(autopilot):
    m, orders = autopilot.mavlink, []
    for _ in range(400):
        autopilot.say(m.heartbeat_encode(2, PX4, 0, OFFBOARD if orders else 0, 4))
        autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
        order = autopilot.heard().get("COMMAND_LONG")
        if order is not None:
            orders.append((order.command, order.param1, order.param2))
    assert orders[0] == (176, 1.0, 6.0) and orders[1] == (400, 1.0, 0.0)
    autopilot.say(m.command_ack_encode(400, 1))
    autopilot.say(m.statustext_encode(2, b"Preflight Fail: Accel #0 uncalibrated"))
    autopilot.heard()
    said = " | ".join(line.text for line in autopilot.got["log"])
    lines = len(autopilot.got["log"])
    autopilot.say(m.command_ack_encode(400, 2, target_system=255, target_component=190))
    autopilot.heard()
    assert len(autopilot.got["log"]) == lines, "the answer is to a ground station"
    assert "refuses arming: TEMPORARILY_REJECTED" in said and "Preflight Fail: Accel #0 uncalibrated" in said


def test_set_points_stop_where_a_controller_is_started_again_in_flight(autopilot):
    """Those of a disarmed controller would have no thrust."""
    m = autopilot.mavlink

    def sent(armed: bool | None) -> set:
        autopilot.say(m.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
        kinds = set()
        for _ in range(120):
            if armed is not None:
                autopilot.node.on_rates_thrust(RatesThrust(0, armed, (0.0, 0.0, 0.0), 9.81 if armed else 0.0))
            kinds |= set(autopilot.heard())
        return kinds & {"SET_ATTITUDE_TARGET", "COMMAND_LONG"}

    assert sent(True) == {"SET_ATTITUDE_TARGET"}
    sent(None)
    assert sent(False) == set() and "was the controller started again?" in autopilot.got["log"][-1].text
    assert sent(True) == {"SET_ATTITUDE_TARGET"}
    assert sent(False) == {"SET_ATTITUDE_TARGET", "COMMAND_LONG"}


def test_a_pilot_who_hands_over_to_a_disarmed_controller_in_flight_keeps_the_motors(autopilot):
    """He has taken the mode of set points back, and the controller was disarmed meanwhile."""
    m = autopilot.mavlink

    def sent(armed: bool, mode: int) -> set:
        autopilot.heard()
        kinds = set()
        for k in range(240):
            if k % 60 == 0:
                autopilot.say(m.heartbeat_encode(2, PX4, ARMED, mode, 4))
            autopilot.node.on_rates_thrust(RatesThrust(0, armed, (0.0, 0.0, 0.0), 9.81 if armed else 0.0))
            kinds |= set(autopilot.heard())
        return kinds & {"SET_ATTITUDE_TARGET", "COMMAND_LONG"}

    assert sent(True, OFFBOARD) == {"SET_ATTITUDE_TARGET"}
    assert sent(True, 0) == {"SET_ATTITUDE_TARGET"}, "without set points PX4 does not let him hand over"
    assert not any("a pilot flies" in line.text for line in autopilot.got["log"])
    assert sent(False, 0) == set() and not any("motors off" in line.text for line in autopilot.got["log"])
    assert autopilot.got["log"][-1].text == "a pilot flies: select this mode only while the controller flies (TRACKING or HOVERING), or on the ground"
    assert sent(False, OFFBOARD) == set() and "until the autopilot is disarmed by its pilot" in autopilot.got["log"][-1].text
    assert sent(True, OFFBOARD) == {"SET_ATTITUDE_TARGET"}
    assert sent(False, OFFBOARD) == {"SET_ATTITUDE_TARGET", "COMMAND_LONG"}


def test_it_disarms_in_flight_what_it_has_flown(autopilot):
    """Both autopilots refuse to disarm in flight unless it is forced."""
    m = autopilot.mavlink
    autopilot.command_disarmed()

    def disarmed(commanded: bool) -> list:
        orders = []
        for armed in (commanded, False):
            for k in range(300):
                if k % 50 == 0:
                    autopilot.say(m.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
                autopilot.node.on_rates_thrust(RatesThrust(0, armed, (0.0, 0.0, 0.0), 9.81 if armed else 0.0))
                if (order := autopilot.heard().get("COMMAND_LONG")) is not None:
                    orders.append((order.command, order.param1, order.param2))
        return orders

    assert set(disarmed(False)) == {(400, 0.0, 0.0)}           # somebody else has armed it
    assert set(disarmed(True)) == {(400, 0.0, 21196.0)}
    autopilot.say(m.command_ack_encode(400, 1))
    autopilot.heard()
    assert "refuses disarming: TEMPORARILY_REJECTED" in autopilot.got["log"][-1].text


def test_kill_stops_the_motors_also_where_no_controller_commands(autopilot):
    """In the autopilot's own failsafe, whose mode is not that of set points. The decision of another time or clock does not count."""
    m = autopilot.mavlink
    autopilot.say(m.heartbeat_encode(2, PX4, ARMED, 0, 4))
    autopilot.heard(2.0)

    def sent(command: Command, stamp: int) -> tuple | None:
        autopilot.node.on_command(ControllerCommand(stamp, command, "a person's decision"))
        order = autopilot.heard().get("COMMAND_LONG")
        return order and (order.command, order.param1, order.param2)

    assert sent(Command.LAND, autopilot.now) is None
    assert sent(Command.KILL, autopilot.now - 2 * SECOND) is None
    assert any("is too old: ignored" in line.text for line in autopilot.got["log"])
    assert sent(Command.KILL, autopilot.now) == sent(Command.KILL, 0) == (400, 0.0, 21196.0)


def test_kill_is_repeated_until_the_autopilot_is_disarmed_and_only_a_command_to_disarm_lets_it_arm_again(autopilot):
    """Though its frame is lost, and a controller goes on commanding."""
    m = autopilot.mavlink

    def seconds(count: float, base_mode: int, armed: bool) -> list[tuple]:
        """What the node orders, and (): that it sends a set point; once each in a row."""
        sent: list[tuple] = []
        for k in range(round(200 * count)):
            if k % 50 == 0:
                autopilot.say(m.heartbeat_encode(2, PX4, base_mode, OFFBOARD, 4))
            autopilot.node.on_rates_thrust(RatesThrust(0, armed, (0.0, 0.0, 0.0), 9.81 * armed))
            said = autopilot.heard()
            sent += [()] * ("SET_ATTITUDE_TARGET" in said and armed)
            sent += [(order.command, order.param1, order.param2)] if (order := said.get("COMMAND_LONG")) else []
        return [order for order, before in zip(sent, [None, *sent]) if order or order != before]

    autopilot.command_disarmed()
    assert seconds(1.0, ARMED, True) == [()]
    autopilot.node.on_command(ControllerCommand(0, Command.KILL, "a person's decision"))
    autopilot.link.recv(1 << 20)                               # it is lost
    assert seconds(3.0, ARMED, True) == [(400, 0.0, 21196.0)] * 3
    assert "KILL was received" in autopilot.got["log"][-1].text
    assert seconds(2.0, 0, True) == []
    assert seconds(2.0, ARMED, True) == []                     # its pilot has armed it: this is not what was killed
    assert seconds(0.1, 0, False) == []
    assert seconds(1.2, 0, True) == [(), (400, 1.0, 0.0), ()]


def test_kill_is_not_repeated_for_long_nor_by_a_clock_that_jumps():
    for jump, count in ((0.0, 5), (-3600.0, 0)):
        machine = Offboard(autopilot=PX4, armed=True, following=True)
        machine.kill(10.0)
        if jump:
            machine.set_time(10.0 + jump)
        assert asked(machine, 20.0, start=10.0 + jump) == [Request.DISARM] * count


def test_a_heartbeat_of_before_kill_does_not_end_it():
    """It was sent before the autopilot had received the request to arm; KILL's own frame is lost."""
    machine = Offboard(autopilot=PX4, following=True)
    machine.arming.command(0.9, True)
    machine.kill(1.0)
    machine.heartbeat(1.1, PX4, 0, OFFBOARD)
    machine.arming.command(1.15, False)
    assert machine.arming.stop is Stop.KILL
    machine.arming.command(2.0, True)
    machine.heartbeat(2.1, PX4, ARMED, OFFBOARD)
    assert machine.next_request(2.1, True, True) is Request.DISARM
    machine.heartbeat(3.1, PX4, 0, OFFBOARD)
    assert machine.next_request(3.2, True, True) is Request.NOTHING


def test_after_kill_commands_with_the_motors_off_disarm_however_late_the_link_is_back():
    machine = Offboard(autopilot=PX4, armed=True, following=True)
    assert asked(machine, 1.0) == []                           # it flies
    machine.kill(1.0)
    asked(machine, 9.0, start=1.0, wanted=False)               # lost, all of it
    assert Request.DISARM in asked(machine, 2.1, start=10.0, wanted=False)


def test_the_rate_of_the_imu_is_requested_until_it_comes_and_a_refusal_is_said(autopilot):
    """An autopilot that restarts has forgotten it."""
    m, own = autopilot.mavlink, itertools.count(SECOND, 5_000_000)

    def second(every: int) -> list[tuple]:
        """Requests of a second in which each so manieth poll has a sample; 0: none has."""
        requests = []
        autopilot.say(m.heartbeat_encode(2, PX4, 0, 0, 4))
        for k in range(200):
            stamp = next(own)
            if every and k % every == 0:
                autopilot.say(m.highres_imu_encode(stamp // 1000, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0, 63))
            if (said := autopilot.heard().get("SET_MESSAGE_INTERVAL")) is not None:
                requests.append((said.command, said.param1, said.param2))
        return requests

    second(0)
    request = (511, 105.0, 5000.0)
    assert second(0) == second(0) == second(4) == second(4) == [request]
    assert "HIGHRES_IMU comes 50 times a second instead of 200, as requested" in {line.text for line in autopilot.got["log"]}
    second(1)
    autopilot.got["log"].clear()
    assert second(1) == second(1) == [] == autopilot.got["log"]
    autopilot.say(m.command_ack_encode(511, 3))
    second(0)
    assert autopilot.got["log"][0].text == "the autopilot refuses to send HIGHRES_IMU at 200 Hz: UNSUPPORTED"
    assert second(0) == [request]


# -- bad input ---------------------------------------------------------------------------------------------------------

def test_a_hosts_clock_that_jumps_is_one_line_and_everything_goes_on(autopilot):
    m = autopilot.mavlink

    def second() -> set[str]:
        """What the node sends in a second with heartbeats, answers to its clock, commands and samples; its new lines."""
        kinds: set[str] = set()
        for k in range(200):
            if k % 50 == 0:
                autopilot.say(m.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
            autopilot.node.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
            own = 5 * SECOND + 5_000_000 * (count := next(counter))
            autopilot.say(m.highres_imu_encode(own // 1000, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0, 63))
            said = autopilot.heard()
            if "TIMESYNC" in said:
                autopilot.say(m.timesync_encode(5 * SECOND + 5_000_000 * (count + 1), said["TIMESYNC"].ts1))
            kinds |= set(said)
        return kinds

    autopilot.command_disarmed()
    counter = itertools.count()
    wanted = {"HEARTBEAT", "TIMESYNC", "SET_ATTITUDE_TARGET", "COMMAND_LONG"}  # disarmed is wanted: it is ordered again and again
    assert second() | second() >= wanted
    assert autopilot.got["log"] == []
    for jump, words in ((-3600, "went back by 3599.995 s"), (7200, "went on by 7200.005 s")):
        autopilot.now += jump * SECOND
        before = len(autopilot.got["imu"])
        assert second() | second() >= wanted
        samples = autopilot.got["imu"][before:]
        assert len(samples) > 390 and all(abs(sample.stamp - autopilot.now) < 2.1 * SECOND for sample in samples)
        assert (np.diff([sample.stamp for sample in samples]) > 0).all()
        line, = autopilot.got["log"]
        assert words in line.text
        autopilot.got["log"].clear()


def test_samples_of_an_autopilot_that_has_started_anew_wait_for_its_new_clock(autopilot):
    m = autopilot.mavlink
    autopilot.heard()
    for own in (500 * SECOND, 2 * SECOND):
        for _ in range(3):
            autopilot.say(m.highres_imu_encode(own // 1000, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0, 63))
        asked = autopilot.heard()
        assert autopilot.got["imu"] == [] and ("TIMESYNC" in asked) == (own == 2 * SECOND)  # it is asked at once
        autopilot.say(m.timesync_encode(own, autopilot.now))
        autopilot.say(m.highres_imu_encode(own // 1000, 0.0, 0.0, -9.81, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0, 63))
        autopilot.heard()
        assert autopilot.got["imu"].pop().stamp == pytest.approx(autopilot.now, abs=10_000_000)
    line, = autopilot.got["log"]
    assert "the autopilot's clock went from 500.000 to 2.000 s at once" in line.text


def test_a_single_sample_of_the_past_is_dropped(autopilot):
    m = autopilot.mavlink
    autopilot.say(m.timesync_encode(500 * SECOND, autopilot.now))
    for own in (500.0, 500.01, 490.0, 500.02, 491.0, 492.0, 500.03, 700.0, 500.04):
        autopilot.say(m.highres_imu_encode(round(own * 1e6), 0.0, 0.0, -9.81, 0.0, 0.0, 0.0, 0, 0, 0, 0, 0, 0, 0, 63))
        autopilot.heard()
    stamps = [sample.stamp for sample in autopilot.got["imu"]]
    assert np.diff(stamps) == pytest.approx(0.01 * SECOND) and len(stamps) == 5 and autopilot.got["log"] == []


def test_a_link_that_has_ended_is_opened_anew(autopilot, monkeypatch):
    ours, theirs = socket.socketpair()
    tried: list[int] = []

    def opened(address: str) -> Link:
        tried.append(autopilot.now)
        if len(tried) < 3:
            raise LinkError(f"{address}: cannot be opened")
        return Link(f"fd:{ours.detach()}")

    monkeypatch.setattr("perch_autopilot.mavlink.Link", opened)
    autopilot.link.close()
    autopilot.link = theirs
    said = autopilot.heard(2.0)
    assert len(tried) == 3 and min(np.diff(tried)) >= 0.2 * SECOND
    assert {"HEARTBEAT", "TIMESYNC"} <= set(said)
    assert replace(autopilot.node.offboard, _last_streaming=-1e9) == Offboard(PX4)  # its state is unknown
    autopilot.say(autopilot.mavlink.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
    autopilot.heard()
    assert autopilot.node.offboard.following
    assert [line.text for line in autopilot.got["log"][:2]] == ["the link to the autopilot has ended", f"{autopilot.node.config.link}: cannot be opened"]


def test_a_link_that_is_opened_anew_in_flight_gives_no_thrust_of_a_controller_that_is_started_again(autopilot, monkeypatch):
    """Until a heartbeat has the autopilot disarmed."""
    m = autopilot.mavlink
    autopilot.say(m.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
    autopilot.heard(1.0)
    ours, theirs = socket.socketpair()
    monkeypatch.setattr("perch_autopilot.mavlink.Link", lambda _: Link(f"fd:{ours.detach()}"))
    autopilot.link.close()
    autopilot.link = theirs
    autopilot.heard(0.3)
    for disarmed in (False, True):
        if disarmed:
            autopilot.say(m.heartbeat_encode(2, PX4, 0, OFFBOARD, 4))
            autopilot.heard()
        for _ in range(20):
            autopilot.node.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
            assert ("SET_ATTITUDE_TARGET" in autopilot.heard()) == disarmed


def test_a_gap_in_the_commands_as_the_link_ends_is_no_new_start_of_the_controller(autopilot, monkeypatch):
    """Its commands with the motors off are obeyed in flight, as after the same gap without the end of the link."""
    autopilot.say(autopilot.mavlink.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4))
    for _ in range(20):
        autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
        autopilot.heard()
    autopilot.heard(0.2)
    ours, theirs = socket.socketpair()
    monkeypatch.setattr("perch_autopilot.mavlink.Link", lambda _: Link(f"fd:{ours.detach()}"))
    autopilot.link.close()
    autopilot.link = theirs
    autopilot.heard(0.1)
    autopilot.node.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
    assert "SET_ATTITUDE_TARGET" in autopilot.heard()


@pytest.mark.parametrize("options", [None, 0.0, 8.0])
def test_a_link_that_is_opened_anew_gives_ardupilot_set_points_as_before(options, monkeypatch):
    """None or all, also before its first heartbeat and its parameter have come again."""
    autopilot = Autopilot(ARDUPILOT)
    m = autopilot.mavlink
    if options is not None:
        autopilot.say(m.param_value_encode(b"GUID_OPTIONS", options, 6, 1, 0))
        autopilot.say(m.param_value_encode(b"ATC_ANGLE_BOOST", 0.0, 2, 1, 0))
    autopilot.command_disarmed()
    ours, theirs = socket.socketpair()
    monkeypatch.setattr("perch_autopilot.mavlink.Link", lambda _: Link(f"fd:{ours.detach()}"))
    autopilot.link.close()
    autopilot.link = theirs
    try:
        autopilot.heard(0.3)
        for begun in (False, True):
            if begun:
                autopilot.say(m.heartbeat_encode(2, ARDUPILOT, ARMED, GUIDED_NOGPS, 4))
            for _ in range(20):
                autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
                assert ("SET_ATTITUDE_TARGET" in autopilot.heard()) == (options == 8.0)
    finally:
        autopilot.node.close()
        autopilot.link.close()


@pytest.mark.parametrize("noise, words", [(b"", "check its power, link and system id"), (b"\x00\xf8\x06" * 9, "is the baud rate right?")])
def test_an_autopilot_that_is_heard_no_more_is_named_and_nothing_is_asked_of_it(autopilot, noise, words):
    sent: set[str] = set()
    autopilot.heard(2.5)  # its last heartbeat was the first one
    for _ in range(600):
        autopilot.link.sendall(noise)
        autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
        sent |= set(autopilot.heard())
    assert autopilot.got["log"][-1].text.startswith("no heartbeat of the autopilot") and words in autopilot.got["log"][-1].text
    assert "COMMAND_LONG" not in sent


def test_another_autopilot_is_refused_by_its_number(autopilot):
    sent: set[str] = set()
    for _ in range(600):
        autopilot.say(autopilot.mavlink.heartbeat_encode(2, 8, 0, 0, 4))  # MAV_AUTOPILOT_INVALID
        autopilot.node.on_rates_thrust(RatesThrust(0, True, (0.0, 0.0, 0.0), 9.81))
        sent |= set(autopilot.heard())
    assert {line.text for line in autopilot.got["log"]} == {"the autopilot is of MAVLink's type 8, not PX4 (12) or ArduPilot (3): not armed"}
    assert "COMMAND_LONG" not in sent


def test_any_bytes_leave_the_node_ready(autopilot):
    """Frames torn at a random place, wrong bytes and noise between them: at last whole ones are read again."""
    m, rng = autopilot.mavlink, np.random.default_rng(3)
    whole = m.heartbeat_encode(2, PX4, ARMED, OFFBOARD, 4).pack(m)
    for _ in range(200):
        torn = bytearray(whole[:rng.integers(1, len(whole) + 1)])
        torn[rng.integers(len(torn))] ^= int(rng.integers(1, 256))
        autopilot.link.sendall(bytes(torn) + rng.bytes(rng.integers(0, 9)))
        autopilot.heard()
    autopilot.node.offboard.armed = False
    autopilot.link.sendall(whole * 20)  # what had begun may swallow 280 bytes
    autopilot.heard()
    assert autopilot.node.offboard.armed
    autopilot.heard(1.1)
    assert autopilot.got["diagnostics"][-1].values["torn_frames"] > 0
    assert "corrupt frames received from the autopilot: check the link and its baud rate" in {line.text for line in autopilot.got["log"]}
