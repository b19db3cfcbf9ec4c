"""Faults at the start end a node with one line and exit code 2, and no motor turns; faults in flight do not end it.

The nodes run as processes, against Betaflight's firmware or against bytes made as an autopilot sends them. Against the firmware they are
started as a user does; the others are forked from a process that has their code.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import pytest
from perch_autopilot import command, firmware, msp
from perch_autopilot.configuration import load_configuration
from perch_autopilot.namespace import NamespaceError
from perch_autopilot.sitl import GRAVITY, LEVEL, Sitl
from perch_autopilot.watchdog import OFF, ON
from perch_eval.domain import reserved_domain
from perch_eval.nodes import executable
from system import forks

PATIENCE = 120.0  # for a process on a busy machine [s]
NODE = "from perch_autopilot.{0}_node import main; main()"
NODES = ("perch_autopilot.betaflight_node", "perch_autopilot.mavlink_node")
CURVE = ("name: mine\nextends: betaflight\nactuation:\n  type: rates_and_thrust\n"
         "  battery: {reference: 16.0, exponent: 1.8, range: [13.6, 16.8]}\n")


@pytest.fixture(autouse=True)
def domain(monkeypatch) -> Iterator[None]:
    with reserved_domain() as number:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        yield


class Forked(forks.Piped):
    """A node's executable, forked, and what it says, as do the processes that it starts."""

    def __init__(self, node: str, words: list[str]) -> None:
        super().__init__(NODES, [executable("perch_autopilot", node), "--ros-args", *words])
        self._said: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with self.stdout as said:
            self._said.append(said.read())

    def communicate(self, timeout: float | None = None) -> tuple[str, None]:
        """As `Popen`'s: when all of them have ended."""
        self.wait(timeout)
        self._reader.join(timeout)
        if self._reader.is_alive():
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        return "".join(self._said), None


Process = subprocess.Popen | Forked


def started(node: str, passed: tuple[int, ...] = (), **parameters: str) -> Process:
    """Forked, unless files are passed on."""
    words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    if not passed:
        return Forked(node, words)
    return subprocess.Popen([sys.executable, "-c", NODE.format(node), "--ros-args", *words], pass_fds=passed,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def ended(process: Process) -> str:
    """What it has said when it has ended."""
    try:
        return process.communicate(timeout=PATIENCE)[0]
    finally:
        process.kill()


def refused(process: Process, words: str) -> None:
    """It ends by itself, with one line and exit code 2."""
    said = ended(process)
    assert process.returncode == 2 and words in said, said
    assert said.startswith("error: ") and said.count("\n") == 1, said


def goes_on(process: Process, *words: str) -> None:
    """It is alive, ends upon SIGTERM only, and has said so."""
    assert process.poll() is None, process.communicate()[0]
    process.send_signal(signal.SIGTERM)
    said = ended(process)
    assert process.returncode in (0, -signal.SIGALRM) and "Traceback" not in said, said
    assert all(word in said for word in words), said


class Peer:
    """The other end of a link by TCP.

    Attributes:
        answers: payload for a command of MSP.
        spoil: what becomes of an answer.
        noise: bytes that are sent beside them.
        heard: all that has come.
    """

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.link = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"
        self.answers = {msp.FC_VARIANT: b"BTFL", msp.FC_VERSION: bytes((4, 6, 0)), msp.STATUS: status(), msp.ANALOG: analog(16.0),
                        msp.RAW_IMU: struct.pack("<9h", 0, 0, 2048, *(0,) * 6)}
        self.spoil, self.noise, self.heard, self._on = (lambda frame: frame), b"", b"", True
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _live(self) -> None:
        self._server.settimeout(0.1)
        parser, link = msp.Parser(), None
        while self._on:
            try:
                if link is None:
                    link = self._server.accept()[0]
                    link.settimeout(0.02)
                link.sendall(self.noise)
                data = link.recv(4096)
            except TimeoutError:
                continue
            except OSError:
                data = b""
            if not data:
                link = None
                continue
            self.heard += data
            for frame in parser.feed(data.replace(b"$M<", b"$M>")):  # requests have the form of answers
                if frame.command in self.answers:
                    link.sendall(self.spoil(msp.request(frame.command, self.answers[frame.command]).replace(b"$M<", b"$M>")))

    @property
    def switches(self) -> set[int]:
        """Of arming, in all frames with channels that have come."""
        frames = msp.Parser().feed(self.heard.replace(b"$M<", b"$M>"))
        return {struct.unpack_from("<5H", frame.payload)[4] for frame in frames if frame.command == msp.SET_RAW_RC}

    def close(self) -> None:
        self._on = False
        self._thread.join()
        self._server.close()


def status(flags: int = 0, armed: bool = False) -> bytes:
    return struct.pack("<HHHIBHBBBBIB", 0, 0, 0, armed, 0, 0, 0, 0, 0, 29, flags, 0)


def analog(voltage: float) -> bytes:
    return struct.pack("<BHHhH", 0, 0, 0, 0, round(100 * voltage))


@pytest.fixture
def peer() -> Iterator[Peer]:
    one = Peer()
    yield one
    one.close()


def torn(frame: bytes) -> bytes:
    return frame[:-1] + bytes((frame[-1] ^ 0x55,))


@contextmanager
def all_started(node: str, peers: dict[str, Peer], **parameters: str) -> Iterator[dict[str, tuple[Process, Peer]]]:
    """A process for each peer, all at once, as a start with a fault waits for seconds."""
    with reserved_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        processes = {name: started(node, link=peer.link, **parameters) for name, peer in peers.items()}
        try:
            yield {name: (process, peers[name]) for name, process in processes.items()}
        finally:
            for name, process in processes.items():
                process.kill(), process.communicate()
                peers[name].close()


AT_START = {
    "another version": ({"answers": {msp.FC_VERSION: bytes((26, 6, 0))}}, "the autopilot runs BTFL 26.6.0, not Betaflight (BTFL) 4.3 to 4.6"),
    "another firmware": ({"answers": {msp.FC_VARIANT: b"INAV"}}, "the autopilot runs INAV 4.6.0"),
    "silence": ({"answers": {}}, "no autopilot answers within 2 s"),
    "another baud rate": ({"answers": {}, "noise": b"\x00\xf8\x06\x9e" * 9}, "bytes received that are not MSP: is the baud rate right"),
    "torn frames only": ({"spoil": torn}, "bytes received that are not MSP: is the baud rate right"),
    "a lasting refusal": ({"answers": {msp.STATUS: status(1 << 23)}}, "the autopilot refuses to arm: accelerometer is not calibrated: calibrate it"),
    "another battery": ({"answers": {msp.ANALOG: analog(12.1)}}, "the battery has 12.1 V: the thrust curve of"),
}


@pytest.fixture(scope="module")
def betaflights(tmp_path_factory) -> Iterator[dict[str, tuple[Process, Peer]]]:
    """A node for each fault of `AT_START`."""
    file, peers = tmp_path_factory.mktemp("faults") / "mine.yaml", {}
    file.write_text(CURVE)
    for name, (fault, _) in AT_START.items():
        peers[name] = peer = Peer()
        given = fault.get("answers")
        peer.answers = {} if given == {} else peer.answers | (given or {})
        peer.spoil, peer.noise = fault.get("spoil", peer.spoil), fault.get("noise", b"")
    with all_started("betaflight", peers, vehicle=str(file)) as processes:
        yield processes


@pytest.mark.parametrize("name", AT_START)
def test_a_fault_at_the_start_is_one_line_and_exit_code_2_and_motors_stay_off(name, betaflights):
    process, peer = betaflights[name]
    refused(process, AT_START[name][1])
    assert peer.switches == set()


@pytest.mark.parametrize("armed", [False, True])
def test_a_fault_after_the_start_does_not_end_the_node(armed, peer, tmp_path):
    """Nor does one at a start in flight: a node that is started again leaves what flies as it is, until the first command."""
    file = tmp_path / "mine.yaml"
    file.write_text(CURVE)
    if armed:
        peer.answers |= {msp.STATUS: status(1 << 23, True), msp.ANALOG: analog(12.1)}
    process = started("betaflight", link=peer.link, vehicle=str(file))
    until(lambda: peer.heard.count(msp.request(msp.RAW_IMU)) > 50, process)
    for fault in ({msp.STATUS: status(1 << 23)}, {msp.ANALOG: analog(12.1)}, {}):
        peer.answers |= fault
        peer.spoil, peer.noise = (torn, b"\x00\xf8\x06\x9e" * 3) if not fault else (peer.spoil, b"")
        begin = len(peer.heard)
        until(lambda: peer.heard.count(msp.request(msp.RAW_IMU), begin) > 150, process)  # noqa: B023  called at once
    goes_on(process, "12.1 V", "corrupt frames received from the autopilot")
    assert peer.switches == set()


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler for a signal."""
    with open(f"/proc/{pid}/status") as lines:
        caught = next(line for line in lines if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def until(what, process: Process) -> None:
    last = time.monotonic() + PATIENCE
    while not what():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < last, "it does not come"
        time.sleep(0.02)


# -- MAVLink -------------------------------------------------------------------------------------------------------------

def heartbeat(autopilot: int) -> bytes:
    common = pytest.importorskip("pymavlink.dialects.v20.common", reason="pymavlink is an optional extra (scripts/setup.py --extra mavlink)")
    return common.MAVLink(None, srcSystem=1, srcComponent=1).heartbeat_encode(2, autopilot, 0, 0, 4).pack(
        common.MAVLink(None, srcSystem=1, srcComponent=1))


MAVLINK_AT_START = {
    "silence": (lambda: b"", "no heartbeat of the autopilot: check its power, link and system id"),
    "another baud rate": (lambda: b"\x00\xf8\x06\x9e" * 9, "corrupt frames: is the baud rate right?"),
    "torn frames only": (lambda: torn(heartbeat(12)), "corrupt frames: is the baud rate right?"),
    "another autopilot": (lambda: heartbeat(8), "the autopilot is of MAVLink's type 8, not PX4 (12) or ArduPilot (3)"),
}


@pytest.fixture(scope="module")
def mavlinks() -> Iterator[dict[str, tuple[Process, Peer]]]:
    """A node for each fault of `MAVLINK_AT_START`."""
    noises = {name: noise() for name, (noise, _) in MAVLINK_AT_START.items()}
    peers = {name: Peer() for name in noises}
    for name, noise in noises.items():
        peers[name].noise = noise
    with all_started("mavlink", peers) as processes:
        yield processes


@pytest.mark.parametrize("name", MAVLINK_AT_START)
def test_a_mavlink_autopilot_that_is_none_is_one_line_and_exit_code_2(name, mavlinks):
    process, peer = mavlinks[name]
    refused(process, MAVLINK_AT_START[name][1])
    assert peer.heard == b""


def test_a_mavlink_autopilot_that_vanishes_does_not_end_the_node(peer):
    peer.noise = heartbeat(12)
    process = started("mavlink", link=peer.link)
    until(lambda: len(peer.heard) > 100, process)
    peer.noise = torn(peer.noise)
    begin = len(peer.heard)
    until(lambda: len(peer.heard) > begin + 300, process)
    goes_on(process, "no heartbeat of the autopilot")


# -- Betaflight's firmware -------------------------------------------------------------------------------------------------

class Bench:
    """The firmware on a bench, by the wall clock, with more lines of configuration.

    Attributes:
        radio: the pilot's channels [us].
        most: largest motor value.
        steps: how many it has lived.
    """

    def __init__(self, *more: str) -> None:
        loaded = load_configuration("betaflight")
        try:
            firmware.find_program()
        except firmware.FirmwareError as missing:
            pytest.skip(str(missing))
        try:
            self.sitl = Sitl(replace(loaded, lines=(*loaded.lines, *more)))
        except NamespaceError as error:
            pytest.skip(str(error))
        self.radio, self.most, self._on = [1500, 1500, 1000, 1500, OFF, OFF, ON], 0.0, True
        self.steps = 0
        self.number = os.dup(self.sitl.file)
        for _ in range(500):
            self._step()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _step(self) -> None:
        self.most = max(self.most, *self.sitl.step((0.0, 0.0, 0.0), GRAVITY, LEVEL, self.radio))
        self.steps += 1

    def _live(self) -> None:
        while self._on:
            self._step()
            time.sleep(0.002)

    def started(self, **parameters: str) -> subprocess.Popen:
        return started("betaflight", (self.number,), link=f"fd:{self.number}", one_g="256.0", **parameters)

    def live(self, steps: int) -> None:
        """Wait while it lives for so many steps."""
        end, last = self.steps + steps, time.monotonic() + PATIENCE
        while self.steps < end:
            assert time.monotonic() < last, "it does not live"
            time.sleep(0.01)

    def close(self) -> None:
        self._on = False
        self._thread.join()
        self.sitl.close()
        os.close(self.number)


def test_a_firmware_that_will_not_arm_is_refused():
    bench = Bench("aux 3 45 3 1700 2100 0 0")  # box 45 is PARALYZE, which stays on until the next start, here by AUX4
    try:
        bench.radio.append(ON)
        bench.live(250)
        bench.radio.pop()
        refused(bench.started(), "the autopilot refuses to arm: paralyzed: restart the autopilot")
        assert bench.most == 0.0
    finally:
        bench.close()


def test_a_firmware_whose_battery_has_no_thrust_curve_is_refused(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(CURVE)
    bench = Bench()
    try:
        refused(bench.started(vehicle=str(file)), "the battery has 0 V: the thrust curve of")
        assert bench.most == 0.0
    finally:
        bench.close()


def test_a_firmware_that_will_arm_when_the_pilot_has_moved_his_stick_is_waited_for():
    bench = Bench()
    bench.radio[2], bench.radio[6] = 1500, OFF
    try:
        process = bench.started()
        until(lambda: catches(process.pid, signal.SIGTERM), process)
        time.sleep(5.0)
        goes_on(process)
        assert bench.most == 0.0
    finally:
        bench.close()


@pytest.mark.parametrize("line, code", [("set p_roll = 180", 0), ("set p_roll = 1", 2)])
def test_a_command_ends_the_command_line_in_which_an_autopilot_does_not_fly(line, code, monkeypatch, tmp_path):
    sent, file = [], tmp_path / "mine.txt"
    file.write_text(line + "\n")

    def answered(answer: bytes) -> None:
        """What is written to the port has this answer, once."""
        pending: list[bytes] = []
        port = SimpleNamespace(write=lambda data: (sent.append(data), pending.append(answer)), read=lambda _: pending.pop() if pending else b"")
        monkeypatch.setattr(command, "Link", lambda address: port)

    answered(b"set p_roll = 180\r\n# ")
    assert command.main(["check", "/dev/null", str(file)]) == code and sent[-1] == b"exit\r\n"
    assert command.main(["configure", "/dev/null", str(file)]) == 0 and sent[-1] == b"save\r\n"
    answered(b"###ERROR\r\n# ")
    assert command.main(["configure", "/dev/null", str(file)]) == 2 and sent[-1] == b"exit\r\n"
