"""The link to an autopilot, and the process that holds it: ports, who may open them, and what goes on when somebody ends."""

from __future__ import annotations

import errno
import os
import pty
import select
import signal
import socket
import struct
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
from perch_autopilot import msp
from perch_autopilot.supervised_link import COMMAND, THROTTLES, LinkSupervisor, SupervisedLink
from perch_autopilot.rate_curve import RateCurve
from perch_autopilot.watchdog import OFF, ON, Watchdog
from perch_autopilot.link import Link, LinkError, PortTaken

CURVES = (RateCurve(400, 900, 0.0), RateCurve(400, 900, 0.3))
STICKS = (1500, 1500, 1500, 1500)


@pytest.mark.parametrize("address", ["/dev/no_such_device", "/dev/null", "tcp:127.0.0.1:1", "/dev/ptmx@12345", "tcp:127.0.0.1:99999", "tcp:a..b:1",
                                     "/dev/no\0device", f"tcp:{100 * 'a'}:1"])
def test_a_wire_that_is_none_is_one_line(address):
    with pytest.raises(LinkError, match=address.replace("[", ".")) as error:
        Link(address)
    assert "\n" not in str(error.value) and "another process" not in str(error.value)


def test_a_serial_line_carries_bytes_and_its_end_is_an_error():
    ours, theirs = pty.openpty()
    link = Link(os.ttyname(theirs) + "@921600")
    try:
        link.write(b"$M<")
        assert os.read(ours, 10) == b"$M<" and link.read() == b""
        os.write(ours, bytes(range(256)))
        got, last = b"", time.monotonic() + 60.0
        while len(got) < 256 and time.monotonic() < last:
            got += link.read(0.1)
        assert got == bytes(range(256))  # raw: nothing is translated
        os.close(theirs)
        os.close(ours)
        with pytest.raises(LinkError, match="has ended"):
            link.read(1.0)
    finally:
        link.close()


def test_a_port_is_set_up_whatever_its_last_user_has_left():
    """Without flow control above all: an autopilot that gives no clear-to-send would never be spoken to."""
    ours, theirs = pty.openpty()
    mode = termios.tcgetattr(theirs)
    mode[0] |= termios.IXON | termios.IXOFF | termios.IGNCR | termios.INLCR
    mode[2] = mode[2] & ~termios.CLOCAL | termios.CRTSCTS | termios.CSTOPB
    mode[6][termios.VMIN] = 0
    termios.tcsetattr(theirs, termios.TCSANOW, mode)
    link = Link(os.ttyname(theirs) + "@921600")
    iflag, oflag, cflag, lflag, _, speed, characters = termios.tcgetattr(theirs)
    assert (iflag, oflag, lflag, speed, characters[termios.VMIN]) == (0, 0, 0, termios.B921600, 1)
    assert cflag & termios.CLOCAL and cflag & termios.CREAD and not cflag & (termios.CRTSCTS | termios.CSTOPB)
    link.close()
    os.close(theirs)
    os.close(ours)


def test_a_full_port_gets_whole_frames_or_none():
    ours, theirs = pty.openpty()
    link, got, last = Link(os.ttyname(theirs)), b"", time.monotonic() + 60.0
    for k in range(5000):
        link.write(msp.request(msp.SET_RAW_RC, struct.pack("<I", k) + bytes(29)))
        if k % 1000 == 999:
            got += os.read(ours, 1 << 16)
    while not got.endswith(msp.request(msp.STATUS)) and time.monotonic() < last:  # what is left of the last frame goes first
        link.write(msp.request(msp.STATUS))
        if select.select([ours], [], [], 0.1)[0]:
            got += os.read(ours, 1 << 16)
    parser = msp.Parser()
    frames = parser.feed(got.replace(b"$M<", b"$M>"))
    numbers = [struct.unpack_from("<I", frame.payload)[0] for frame in frames if frame.command == msp.SET_RAW_RC]
    assert parser.checksum_errors == parser.skipped == 0 and frames[-1].command == msp.STATUS
    assert 100 < len(numbers) < 5000 and numbers == sorted(set(numbers))
    link.close()
    os.close(theirs)
    os.close(ours)


@pytest.mark.slow
def test_the_supervisor_sends_without_commands_reopens_the_link_and_ends_with_the_motors_off():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(120.0)
        link = SupervisedLink(f"tcp:127.0.0.1:{server.getsockname()[1]}", 1450, 1420, 4.0, CURVES)
        link.command(False, (1500, 1500, 1000, 1500))
        frame = msp.channels((1500, 1500, 1000, 1500, OFF, OFF))
        for _ in range(2):  # the first link ends; the supervisor opens another
            with server.accept()[0] as peer:
                peer.settimeout(120.0)
                got = b""
                while len(got) < 5 * len(frame):
                    got += peer.recv(4096)
                assert got[:4 * len(frame)] == 4 * frame
        link.close()
        assert link.process.wait(120.0) == 0


@pytest.mark.slow
@pytest.mark.parametrize("taken", [False, True])
def test_a_supervisor_whose_link_is_lost_ends_when_the_autopilot_has_been_disarmed_or_belongs_to_another(taken):
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(120.0)
        address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        link = SupervisedLink(address, 1450, 1420, 0.2, CURVES)
        with server.accept()[0] as peer:
            peer.settimeout(120.0)
            link.command(True, STICKS)
            assert peer.recv(4096)
            port = server.getsockname()[1]
            server.close()
            link.close()
    time.sleep(1.0)                                            # motors should be off, and the link cannot be opened
    assert link.process.poll() is None
    if taken:
        with socket.socket(socket.AF_UNIX) as lock:
            lock.bind(f"\0perch_autopilot {address}")
            assert link.process.wait(120.0) == 0
        return
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(120.0)
        with server.accept()[0] as peer:
            peer.settimeout(120.0)
            assert peer.recv(4096).startswith(msp.channels((1500, 1500, 1000, 1500, OFF, OFF)))
            assert link.process.wait(120.0) == 0


def test_a_supervisor_tells_its_mode_again_when_a_lost_link_is_back():
    """The end of the link would be what the node reports, and why it does not arm, for the rest of the flight otherwise."""
    node, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    now, said = 0.0, []
    with socket.create_server(("127.0.0.1", 0)) as server, node, theirs:
        supervisor = LinkSupervisor(f"tcp:127.0.0.1:{server.getsockname()[1]}", theirs, Watchdog(1450, 1420), lambda: now)
        peer = server.accept()[0]
        node.setblocking(False)
        for now in (0.01, 0.02, 0.3):
            node.send(b"C" + COMMAND.pack(True, *STICKS))
            for _ in range(3):
                supervisor.work(0.1)
            with suppress(BlockingIOError):
                while True:
                    said.append(node.recv(100)[1:].decode().split(":")[0])
            peer.close()
        assert said == ["following", "the link to the autopilot has ended", "following"]
        supervisor._link.close()


class Supervised:
    """A supervisor of this process in a time of its own, with the node's and the autopilot's end of its sockets."""

    def __init__(self) -> None:
        self.now, self.parser = 0.0, msp.Parser()
        self.node, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.autopilot, ours = socket.socketpair()
        self.autopilot.setblocking(False)
        self.supervisor = LinkSupervisor(f"fd:{ours.detach()}", theirs, Watchdog(1450, 1420, curves=CURVES), lambda: self.now)

    def told(self, *packets: bytes) -> None:
        """Give it packets of the node."""
        for packet in packets:
            self.node.send(packet)
            self.supervisor.work(0.0)

    def frames(self, seconds: float, attitude: tuple[int, int, int] | None = None) -> list[tuple[float, msp.Frame]]:
        """What leaves for the autopilot in a time, with the moments; requests of its attitude are answered, unless it is None [0.1, 0.1, 1 deg]."""
        sent, end = [], self.now + seconds
        while self.now < end - 1e-9:
            self.now += 0.001
            self.supervisor.work(0.0)
            with suppress(BlockingIOError):
                sent += [(self.now, frame) for frame in self.parser.feed(self.autopilot.recv(4096).replace(b"$M<", b"$M>"))]
                if attitude is not None and sent[-1][1].command == msp.ATTITUDE:
                    self.autopilot.send(msp.request(msp.ATTITUDE, struct.pack("<3h", *attitude)).replace(b"$M<", b"$M>"))
        return sent

    def channels(self, seconds: float, **options) -> list[tuple[int, ...]]:
        """Channels that leave in a time [us]."""
        return [struct.unpack("<6H", frame.payload) for _, frame in self.frames(seconds, **options) if frame.command == msp.SET_RAW_RC]


@pytest.fixture
def supervised() -> Iterator[Supervised]:
    one = Supervised()
    yield one
    for end in (one.node, one.autopilot, one.supervisor._control, one.supervisor._link):
        if end is not None:
            end.close()


def test_frames_leave_at_200_hz_from_the_first_command_on_whatever_the_rate_of_the_commands(supervised):
    assert supervised.frames(0.5) == []
    supervised.told(b"C" + COMMAND.pack(True, *STICKS))
    moments = [moment for moment, frame in supervised.frames(1.0) if frame.command == msp.SET_RAW_RC]
    assert len(moments) == pytest.approx(200, abs=1) and max(b - a for a, b in zip(moments, moments[1:])) < 0.0061


def test_the_supervisor_does_what_the_node_says(supervised):
    """Throttles of another battery, motors that turn already, KILL, and requests that are passed on."""
    supervised.told(b"T", b"C" + COMMAND.pack(True, *STICKS))
    assert set(supervised.channels(0.01)) == {(*STICKS, ON, OFF)}, "motors that turn do not wait for the time of arming"
    supervised.told(b"H" + THROTTLES.pack(1470, 1430), b"R" + msp.request(msp.ANALOG))
    assert msp.ANALOG in {frame.command for _, frame in supervised.frames(0.01)}
    assert supervised.channels(0.1)[-1] == (1500, 1500, 1470, 1500, ON, ON)
    assert supervised.channels(0.6)[-1] == (1500, 1500, 1430, 1500, ON, ON)
    supervised.told(b"C" + COMMAND.pack(True, *STICKS))
    assert supervised.channels(0.01)[-1][4] == ON
    supervised.told(b"K")
    assert {channels[4] for channels in supervised.channels(0.1)} == {OFF}


def test_far_from_level_the_supervisor_asks_for_the_attitude_and_levels_by_rates(supervised):
    supervised.told(b"T", b"C" + COMMAND.pack(True, *STICKS))
    assert {frame.command for _, frame in supervised.frames(0.015)} == {msp.SET_RAW_RC}
    roll, *rest = supervised.channels(0.1, attitude=(800, 0, 0))[-1]
    assert roll < 1500 and rest == [1500, 1450, 1500, ON, OFF], "it lies on its right side: roll to the left"
    assert supervised.channels(0.1)[-1] == (1500, 1500, 1450, 1500, ON, ON), "its attitude is old: by its own mode"


def test_a_supervisor_waits_a_minute_for_a_lost_link_and_not_for_ever(supervised):
    supervised.told(b"C" + COMMAND.pack(True, *STICKS))
    supervised.frames(0.1)
    supervised.supervisor._address = "/dev/no_such_device"
    supervised.autopilot.close()
    supervised.node.close()
    ended = []
    while not ended and supervised.now < 200.0:
        supervised.now += 0.01
        supervised.supervisor.work(0.0)
        ended += [supervised.now] * (supervised.supervisor._final_frames >= 10)
    assert 64.0 < ended[0] < 65.0, "a minute after the descent of 4 s has ended"


def test_a_process_for_the_link_that_cannot_be_started_is_one_line(monkeypatch):
    """It is started in flight, too, where the one before was ended for want of memory."""
    def refused(*_, **__):
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr("subprocess.Popen", refused)
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(LinkError, match="/dev/x: the process that holds the link cannot be started: Cannot allocate memory$"):
        SupervisedLink("/dev/x", 1450, 1420, 4.0, CURVES)
    assert len(os.listdir("/proc/self/fd")) == files


def test_a_link_that_is_opened_again_does_not_wait_for_an_autopilot_that_does_not_answer(monkeypatch):
    """The nodes' loops would stand still for 3 s. A server whose queue is full does not answer."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        Link(address).close()
        monkeypatch.setattr(socket, "create_connection", lambda *_, **__: pytest.fail("it waits"))
        link = Link(address)
        assert not link.connected() and not link.write(b"dropped") and link.read() == b""
        server.accept()[0].close()                             # its queue is free: the next attempt of the system succeeds
        last = time.monotonic() + 60.0
        while not link.connected():
            assert time.monotonic() < last
            time.sleep(0.01)
        assert link.write(b"$M<")
        with server.accept()[0] as peer:
            assert peer.recv(9) == b"$M<"
        link.close()
    with pytest.raises(LinkError, match="Connection refused"):
        link = Link(address)
        while not link.connected():
            assert time.monotonic() < last


def test_a_link_that_is_opened_again_finds_an_autopilot_whose_name_has_another_address(monkeypatch):
    """A vehicle that was restarted may have got another address; here another port stands for it."""
    with socket.create_server(("127.0.0.1", 0)) as before, socket.create_server(("127.0.0.1", 0)) as after:
        found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", before.getsockname())]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        Link("tcp:moving-vehicle:5761").close()
        before.close()
        found = [(socket.AF_INET6, socket.SOCK_STREAM, 6, "", ("::1", 1, 0, 0)), (socket.AF_INET, socket.SOCK_STREAM, 6, "", after.getsockname())]
        last, connected = time.monotonic() + 60.0, False
        while not connected:
            assert time.monotonic() < last
            with suppress(LinkError):
                link = Link("tcp:moving-vehicle:5761")
                while not (connected := link.connected()):
                    time.sleep(0.01)
        after.accept()[0].close()
        link.close()


def test_a_link_is_opened_again_where_no_thread_can_be_made_to_resolve_its_name(monkeypatch):
    """The supervisor, which commands a descent, would end in flight."""
    def refused(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        Link(address).close()
        with monkeypatch.context() as without_threads:
            without_threads.setattr(threading.Thread, "start", refused)
            Link(address).close()
        started = []
        monkeypatch.setattr(threading.Thread, "start", lambda thread: started.append(thread))
        Link(address).close()
        assert len(started) == 1  # the name is looked up when threads can be made again


@pytest.fixture(params=["serial", "tcp"])
def address(request) -> Iterator[str]:
    """A serial port, or one by TCP."""
    if request.param == "tcp":
        with socket.create_server(("127.0.0.1", 0)) as server:
            yield f"tcp:127.0.0.1:{server.getsockname()[1]}"
    else:
        ours, theirs = pty.openpty()
        yield os.ttyname(theirs)
        os.close(theirs)
        os.close(ours)


def test_a_port_belongs_to_one_process_at_a_time(address):
    first = Link(address)
    for _ in range(2):
        with pytest.raises(PortTaken, match=f"^{address}: another process has this port"):
            Link(address)
    first.close()
    Link(address).close()


def test_a_port_that_cannot_be_set_up_is_not_left_open():
    ours, theirs = pty.openpty()
    files = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(LinkError, match="@12345: 12345 is not a baud rate"):
            Link(f"{os.ttyname(theirs)}@12345")
        with pytest.raises(LinkError, match="cannot be opened"):
            Link("tcp:127.0.0.1:1")
    assert len(os.listdir("/proc/self/fd")) == files
    os.close(theirs)
    os.close(ours)


def commanded(link: SupervisedLink, file: int, seconds: float, armed: bool | None = True) -> list[int]:
    """Arming switches that reach a port's other end [us] while commands are sent for a time; None: none is."""
    parser, switches, last = msp.Parser(), [], time.monotonic() + seconds
    while time.monotonic() < last:
        if armed is not None:
            link.command(armed, STICKS)
        time.sleep(0.005)
        try:
            data = os.read(file, 1 << 16)
        except BlockingIOError:
            continue
        frames = parser.feed(data.replace(b"$M<", b"$M>"))
        switches += [int.from_bytes(frame.payload[8:10], "little") for frame in frames if frame.command == msp.SET_RAW_RC]
    return switches


@pytest.mark.slow
def test_what_flies_is_landed_by_one_process_alone():
    """A node that ends in flight leaves the port to its supervisor; the next node gets it when the motors are off."""
    ours, theirs = pty.openpty()
    os.set_blocking(ours, False)
    address = os.ttyname(theirs)
    link = SupervisedLink(address, 1450, 1420, 4.0, CURVES)    # long enough for the next node to start meanwhile
    assert commanded(link, ours, 0.3, armed=None) == []        # before the first command nothing is said
    switches, last = [], time.monotonic() + 120.0
    while not switches and time.monotonic() < last:
        switches = commanded(link, ours, 0.3)
    assert set(switches) == {ON}
    link.close()
    with pytest.raises(LinkError, match="another process has this port"):
        SupervisedLink(address, 1450, 1420, 4.0, CURVES)
    switches = []
    while link.process.poll() is None and time.monotonic() < last:  # nothing is lost in a full port
        switches += commanded(link, ours, 0.1, armed=None)
    assert link.process.wait(0.0) == 0
    switches += commanded(link, ours, 0.1, armed=None)
    assert ON in switches and switches[-1] == OFF and switches == sorted(switches, reverse=True)
    SupervisedLink(address, 1450, 1420, 4.0, CURVES).close()
    os.close(theirs)
    os.close(ours)


def test_the_end_of_the_process_that_holds_the_link_is_told_again_and_again():
    """Also where commands had not been read, which ends the connection otherwise."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = SupervisedLink(f"tcp:127.0.0.1:{server.getsockname()[1]}", 1450, 1420, 4.0, CURVES)
        os.kill(link.process.pid, signal.SIGSTOP)
        link.command(True, STICKS)
        link.process.kill()
        link.process.wait(120.0)
        for _ in range(3):
            with pytest.raises(LinkError, match="the process that holds the link has ended"):
                link.receive(60.0)
            link.command(False, STICKS)
        link.close()
