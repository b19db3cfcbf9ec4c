"""The order of a simulated flight: answer times never change who sees what at which step; the silent are named, dropped and rejoin."""

from __future__ import annotations

import os
import struct
import threading
from dataclasses import dataclass
from multiprocessing import connection as sockets

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from perch_core.component import Action, Client, Component, Input, Output, Service, Unavailable, Timer
from perch_core.errors import PerchError
from perch_core.values import CameraImage
from perch_sim.lockstep import Answer, Arrival, LocalParticipant, Packet, PendingInput, Schedule, Task, local_servers
from perch_sim.lockstep.link import NonBlockingSender, ParticipantListener, address, pack, receive, unpack
from perch_sim.pacing import MAX_CATCH_UP, Pacing

MS = 1_000_000
STEP = 2 * MS


@dataclass(frozen=True)
class Nothing:
    """No parameters."""


class Vehicle(Component[Nothing]):
    """An IMU sample at each step, a frame every `every` steps that arrives 4 ms after its exposure."""

    motor_command = Input(tuple, "motor_command")
    imu = Output(int, "imu/data_raw")
    image, info = Output(CameraImage, "camera_down/image_raw"), Output(int, "camera_down/camera_info")

    def __init__(self, every: int = 4, draw=None) -> None:
        super().__init__(Nothing())
        self.time, self.every, self.draw = 0, every, draw
        self.commands: list[tuple] = []

    def advance(self) -> list[Arrival]:
        self.time += STEP
        arrivals = []
        if self.time // STEP % self.every == 0:
            pixels, ready = self.draw(self.time) if self.draw else (np.zeros((1, 1), np.uint8), None)
            image = CameraImage(self.time, "camera", 1, 1, "mono8", pixels, ready)
            self.info(self.time), self.image(image)
            arrivals = [Arrival("down", self.time, self.time - 4 * MS, image)]
        self.imu(self.time)
        return arrivals

    def on_motor_command(self, command: tuple) -> None:
        self.commands.append((self.time, command))


class Vio(Component[Nothing]):
    imu, image = Input(int, "imu/data_raw"), Input(CameraImage, "camera_down/image_raw")
    info = Input(int, "camera_down/camera_info")
    state, odometry = Output(tuple, "vio/state"), Output(tuple, "vio/odometry")

    def __init__(self) -> None:
        super().__init__(Nothing())
        self.newest = 0

    def on_imu(self, stamp: int) -> None:
        self.newest = stamp

    def on_info(self, stamp: int) -> None:
        pass

    def on_image(self, image: CameraImage) -> None:
        self.state((image.stamp, self.newest)), self.odometry((image.stamp, self.newest))


class Estimator(Component[Nothing]):
    imu, state, vio = Input(int, "imu/data_raw"), Input(tuple, "vio/state"), Input(tuple, "vio/odometry")
    odometry = Output(tuple, "odometry")

    def __init__(self) -> None:
        super().__init__(Nothing())
        self.last = 0

    def on_state(self, pose: tuple) -> None:
        self.last = pose[0]

    on_vio = on_state

    def on_imu(self, stamp: int) -> None:
        self.odometry((stamp, self.last))


class Controller(Component[Nothing]):
    odometry, order = Input(tuple, "odometry"), Input(int, "trajectory")
    motor_command = Output(tuple, "motor_command")

    def __init__(self) -> None:
        super().__init__(Nothing())
        self.order_now = 0

    def on_order(self, order: int) -> None:
        self.order_now = order

    def on_odometry(self, state: tuple) -> None:
        self.motor_command((*state, self.order_now))


class Mission(Component[Nothing]):
    odometry, line = Input(tuple, "odometry"), Input(int, "powerlines")
    trajectory = Output(int, "trajectory")
    tick = Timer(0.02)

    def __init__(self) -> None:
        super().__init__(Nothing())
        self.seen = 0

    def on_odometry(self, state: tuple) -> None:
        self.seen += 1

    def on_line(self, line: int) -> None:
        self.seen += 1000

    def on_tick(self, now: int) -> None:
        self.trajectory(now + self.seen)


class Mapper(Component[Nothing]):
    powerlines = Output(int, "powerlines")
    look = Timer(0.05)

    def on_look(self, now: int) -> None:
        self.powerlines(now)


class Logged:
    """A participant that answers after so many calls, and what it was given at which step."""

    def __init__(self, inner: LocalParticipant, waits=()) -> None:
        self.inner, self.name, self.inputs, self.waits = inner, inner.name, inner.inputs, list(waits)
        self.log: list = []
        self.left, self.dead = 0, False

    def begin(self, now, batch):
        assert self.left == 0
        self.log.append((now, [(p.channel, p.value.stamp if isinstance(p.value, CameraImage) else p.value) for p in batch]))
        self.left = self.waits.pop(0) if self.waits else 0
        self.inner.begin(now, batch)

    def results(self):
        if self.dead:
            return None
        if self.left:
            self.left -= 1
            return None
        return self.inner.results()

    def set_channel_filter(self, is_taken):
        self.inner.set_channel_filter(is_taken)


def tasks(vio: int, mission: int) -> dict[str, Task]:
    return {"estimator": Task(), "controller": Task(), "vio": Task(vio * 1e-3), "mapper": Task(0.003, 25),
            "mission": Task(mission * 1e-3, 10)}


COMPONENTS = {"vio": Vio, "estimator": Estimator, "controller": Controller, "mission": Mission, "mapper": lambda: Mapper(Nothing())}


def logged(name: str, waits=()) -> Logged:
    return Logged(LocalParticipant(COMPONENTS[name](), name=name), waits)


def flown(latencies, every, waits, events=(), steps=60, draw=None):
    """Who saw what, and what the vehicle was commanded. `events`: step -> list of (drop or join, name)."""
    crew = [logged(name, waits.get(name, ())) for name in ("mission", "vio", "controller", "estimator", "mapper")]
    vehicle = Vehicle(every, draw)
    schedule = Schedule(vehicle, crew, tasks(*latencies))
    late = {}
    for index in range(steps):
        for what, name in dict(events).get(index, ()):
            if what == "drop":
                schedule.drop(name)
            else:
                late.setdefault(name, []).append(logged(name, waits.get(name, ())))
                schedule.join(late[name][-1])
        for _ in range(10_000):
            if schedule.advance():
                break
            assert schedule.pending()
        else:
            raise AssertionError("it waits for ever")
        assert schedule.index == index + 1
    return [(c.name, c.log) for c in crew], [(name, c.log) for name, cs in late.items() for c in cs], vehicle.commands


def same(flight, at_once):
    """The same for everybody, but that slow ones may have begun less when the flight or their part in it ended."""
    assert flight[2] == at_once[2]
    for one, other in zip(flight[0] + flight[1], at_once[0] + at_once[1], strict=True):
        name, log = one
        assert log == (other[1] if name in ("estimator", "controller") else other[1][:len(log)])
        assert len(other[1]) - len(log) <= 5


WAITS = st.dictionaries(st.sampled_from(sorted(COMPONENTS)), st.lists(st.integers(0, 40), max_size=60))
LATENCIES = st.tuples(st.integers(2, 40), st.integers(2, 40))
EVENTS = st.dictionaries(st.integers(1, 59), st.lists(st.tuples(st.sampled_from(["drop", "join"]), st.sampled_from(sorted(COMPONENTS))),
                                                     min_size=1, max_size=2), max_size=5)


@given(LATENCIES, st.integers(1, 12), WAITS)
def test_answer_times_never_change_who_sees_what_at_which_step(latencies, every, waits):
    same(flown(latencies, every, waits), flown(latencies, every, {}))


@given(LATENCIES, st.integers(1, 12), WAITS, EVENTS)
def test_nor_do_they_where_participants_leave_and_rejoin(latencies, every, waits, events):
    same(flown(latencies, every, waits, events.items()), flown(latencies, every, {}, events.items()))


@given(LATENCIES, st.integers(1, 12), st.lists(st.integers(0, 30), max_size=60))
def test_nor_does_the_time_that_images_are_drawn_in(latencies, every, looks):
    """An image is there after so many looks at it."""
    def draw_slowly():
        left = list(looks)

        def draw(stamp):
            count = [left.pop(0) if left else 0]

            def ready(timeout):
                count[0] -= 1
                return count[0] < 0

            return np.zeros((1, 1), np.uint8), ready
        return draw

    same(flown(latencies, every, {}, draw=draw_slowly()), flown(latencies, every, {}))


@given(LATENCIES, st.integers(1, 12))
def test_results_count_exactly_from_when_they_are_due(latencies, every):
    """Against a list of dues: a pose counts from max(middle + latency, arrival + one period), an order from tick + latency."""
    crew, _, commands = flown(latencies, every, {})
    vio, mission = latencies
    poses = [(max(t - 4 * MS + vio * MS, t + STEP), t) for t in range(STEP, 61 * STEP, STEP) if t // STEP % every == 0]
    ticks = [STEP + k * 10 * STEP for k in range(6)]
    for now, (stamp, pose, order) in commands:
        assert stamp == now
        assert pose == max((t for due, t in poses if due <= now), default=0)
        assert (order > 0) == any(t + max(mission * MS, STEP) <= now for t in ticks)
    batches = dict(crew)["estimator"]
    for now, batch in batches:
        channels = [channel for channel, _ in batch]
        assert channels == sorted(channels[:-1]) + ["imu/data_raw"]


def test_a_fast_participant_that_is_silent_is_named_and_the_flight_goes_on_without_it():
    mute = logged("controller")
    schedule = Schedule(Vehicle(), [logged("estimator"), mute], tasks(10, 10))
    assert schedule.advance()
    mute.dead = True
    assert not schedule.advance() and not schedule.advance()
    assert schedule.pending() == [PendingInput("controller", "its answer to the present step", 2 * STEP)]
    schedule.drop("controller")
    assert schedule.advance() and schedule.advance() and schedule.names == ["estimator"]


def test_a_fast_participant_that_rejoins_while_it_is_awaited_gets_the_present_batch_again():
    mute, vehicle = logged("controller"), Vehicle()
    schedule = Schedule(vehicle, [logged("estimator"), mute], tasks(10, 10))
    mute.dead = True
    assert not schedule.advance()
    back = logged("controller")
    schedule.join(back)
    assert schedule.advance() and back.log == mute.log
    assert vehicle.commands == [(STEP, (STEP, 0, 0))]


def test_a_slow_one_that_hangs_is_named_with_the_trigger_of_what_it_owes():
    vio = logged("vio")
    vio.dead = True
    schedule = Schedule(Vehicle(every=3), [logged("estimator"), logged("controller"), vio], tasks(10, 10))
    steps = 0
    while schedule.advance():
        steps += 1
    assert steps == 5  # the frame of step 3, exposed at 2 ms, counts from 12 ms, step 6
    assert schedule.pending() == [PendingInput("vio", "its results", 3 * STEP)]
    schedule.drop("vio")
    assert all(schedule.advance() for _ in range(20))


def test_a_rejoined_participant_gets_what_is_latched_and_its_inbox_anew():
    schedule = Schedule(Vehicle(every=5), [logged(name) for name in ("estimator", "controller", "mapper", "vio")], tasks(10, 10))
    assert all(schedule.advance() for _ in range(32))
    mission, vio = logged("mission"), logged("vio")
    schedule.join(mission), schedule.join(vio)
    assert all(schedule.advance() for _ in range(10))
    assert mission.log[0][1][0] == ("powerlines", 26 * STEP)  # the newest, once
    assert [channel for channel, _ in mission.log[0][1]].count("powerlines") == 1
    assert mission.log[0][1][1] == ("odometry", (33 * STEP, 25 * STEP))  # the last pose went with the old vio
    assert vio.log[0][1][:2] == [("camera_down/camera_info", 30 * STEP), ("imu/data_raw", 33 * STEP)]


def test_an_image_that_never_comes_is_dropped_with_its_trigger_and_nothing_else():
    lost = {8 * STEP}
    vio = logged("vio")
    schedule = Schedule(Vehicle(draw=lambda stamp: ((lambda region=None: None) if stamp in lost else np.zeros((1, 1), np.uint8),
                                                    lambda timeout: True)), [vio], tasks(10, 10))
    assert all(schedule.advance() for _ in range(13))
    assert [now for now, _ in vio.log] == [4 * STEP, 12 * STEP]
    stamps = [value for _, batch in vio.log for channel, value in batch if channel == "imu/data_raw"]
    assert stamps == [STEP * k for k in range(1, 13)]
    assert [value for channel, value in vio.log[1][1] if channel.endswith("image_raw")] == [12 * STEP]


def test_the_flight_waits_for_the_third_undrawn_image_of_a_camera_even_where_nobody_takes_it():
    drawn: set[int] = set()
    schedule = Schedule(Vehicle(every=2, draw=lambda t: (np.zeros((1, 1), np.uint8), lambda timeout: t in drawn)), [], tasks(10, 10))
    assert all(schedule.advance() for _ in range(5)) and not schedule.advance()
    assert schedule.pending() == [PendingInput("camera_down", "an image", 2 * STEP)] and schedule.await_image(0.0)
    drawn.add(2 * STEP)
    assert schedule.advance() and not schedule.await_image(0.0)


def test_a_participant_whose_camera_sends_nothing_is_given_what_came_all_the_same():
    vio = logged("vio")
    schedule = Schedule(Vehicle(every=10**6), [vio], tasks(10, 10))
    assert all(schedule.advance() for _ in range(1100))
    assert [len(batch) for _, batch in vio.log] == [501, 500]


def test_nobody_joins_without_a_task():
    with pytest.raises(PerchError, match="'vi0' is not one of estimator, controller, vio"):
        Schedule(Vehicle(), [LocalParticipant(Vio(), name="vi0")], tasks(10, 10))


# -- components in this process ----------------------------------------------------------------------------------------


class Planner(Component[Nothing]):
    plan = Service(int, int, "plan_perch")

    def on_plan(self, request, reply):
        if request < 0:
            raise PerchError("below zero")
        reply(2 * request), reply(-1)


class Asking(Component[Nothing]):
    number, said = Input(int, "number"), Output(str, "said")
    plan = Client(int, int, "plan_perch")
    perch = Action(int, int, int, "perch")
    tick = Timer(0.02)

    def on_number(self, number):
        self.plan(number, number)

    def on_plan(self, request, answer):
        self.said(f"answer {answer.reason if isinstance(answer, Unavailable) else answer}")

    def on_perch(self, goal):
        self.said(f"goal {goal}")
        return "" if goal > 0 else "not positive"

    def on_tick(self, now):
        self.said(f"tick {now}")


def said(participant, now, *numbers):
    participant.begin(now, [Packet("number", n) for n in numbers])
    results = participant.results()
    return None if results is None else [packet.value for packet in results]


def test_answers_come_in_the_first_batch_in_which_they_count():
    asking = LocalParticipant(Asking(Nothing()), send_request=local_servers([LocalParticipant(Planner(Nothing()))]))
    assert asking.name == "asking"
    assert said(asking, 0, 30 * MS) == ["tick 0"]
    assert said(asking, 20 * MS) == ["tick 20000000"]
    assert said(asking, 40 * MS) == ["answer 60000000", "tick 40000000"]
    assert said(LocalParticipant(Asking(Nothing())), 0, 0) == ["tick 0"]


def asking_with_open_answers() -> tuple[LocalParticipant, list[Answer]]:
    """A participant that asks, and the answers to its requests, which the test gives."""
    answers: list[Answer] = []

    def ask(channel, request):
        answers.append(Answer())
        return answers[-1]

    return LocalParticipant(Asking(Nothing()), send_request=ask), answers


def test_a_batch_waits_for_an_answer_that_counts_from_its_stamp_or_before():
    asking, answers = asking_with_open_answers()
    assert said(asking, 0, 30 * MS) == ["tick 0"] and said(asking, 20 * MS) == ["tick 20000000"]
    assert said(asking, 40 * MS) is None and asking.results() is None
    answers[0]("there")
    assert [packet.value for packet in asking.results()] == ["answer there", "tick 40000000"]


def test_servers_that_are_missing_or_fail_answer_all_the_same():
    asking = LocalParticipant(Asking(Nothing()), send_request=local_servers([]))
    said(asking, 0, 1)
    assert said(asking, 2)[0] == "answer no server for 'plan_perch'"
    failed = Answer()
    failed.result = lambda: 1 // 0
    failed(0)
    asking = LocalParticipant(Asking(Nothing()), send_request=lambda channel, request: failed)
    said(asking, 0, 1)
    assert said(asking, 2)[0].startswith("answer ZeroDivisionError")


def test_a_first_batch_waits_for_the_goal_that_holds_it_and_goals_go_in_front_of_batches():
    asking, verdicts = LocalParticipant(Asking(Nothing()), await_goal="perch"), []
    assert said(asking, 0) is None
    asking.goal("perch", 1, verdicts.append)
    assert [packet.value for packet in asking.results()] == ["goal 1", "tick 0"]
    asking.goal("perch", -1, verdicts.append)
    assert said(asking, 20 * MS) == ["goal -1", "tick 20000000"] and verdicts == ["", "not positive"]
    early = LocalParticipant(Asking(Nothing()), await_goal="perch")
    early.goal("perch", 2)
    assert said(early, 0) == ["goal 2", "tick 0"]
    with pytest.raises(PerchError, match="'park' is not one of its"):
        LocalParticipant(Asking(Nothing()), await_goal="park")


def test_packets_make_the_form_that_is_asked_for_once():
    class Codec:
        calls = 0

        def encode(self, channel, value):
            self.calls += 1
            return str(value).encode()

        def decode(self, channel, data):
            self.calls += 1
            return int(data)

    codec = Codec()
    assert (packet := Packet("a", 3, codec)).data == packet.data == b"3" and codec.calls == 1
    assert (packet := Packet.received("a", b"4", codec)).value == packet.value == 4 and codec.calls == 2
    with pytest.raises(TypeError, match="a: a packet without a codec"):
        Packet("a", 3).data


@given(st.lists(st.integers(0, 200) | st.integers(200, 600), min_size=1, max_size=60))
def test_pacing_keeps_up_with_the_clock_or_says_what_it_gave_up(waits):
    period, now, done, late = 10, 1000, 0, 0
    pacing = Pacing(period, now)
    for wait in waits:
        now += wait
        behind = (now - 1000) // period - done - pacing.skipped
        due = pacing.due(now)
        assert due == min(behind, MAX_CATCH_UP), "what can be made up for is"
        done, late = done + due, late + max(behind - 1, 0)
        assert done + pacing.skipped == (now - 1000) // period  # every period is done or owned up to
        assert pacing.misses == late, "all but the newest begin more than a period late"


def test_a_batch_that_is_cut_short_is_refused():
    packets = [Packet.received("imu/data_raw", b"1234567"), Packet.received("clock", b"")]
    data = pack(5, packets)
    stamp, read = unpack(data, None)
    assert stamp == 5 and [(p.channel, p.data) for p in read] == [(p.channel, p.data) for p in packets]
    for length in range(len(data)):
        with pytest.raises(PerchError, match="not a batch"):
            unpack(data[:length], None)


def test_a_flight_begun_anew_has_its_timers_at_once_and_the_answers_of_the_old_one():
    asking, answers = asking_with_open_answers()
    assert said(asking, 40_000 * MS, 60_000 * MS) == ["tick 40000000000"]
    assert said(asking, 1_000 * MS) is None
    answers[0]("of the old one")
    assert [packet.value for packet in asking.results()] == ["answer of the old one", "tick 1000000000"]
    assert said(asking, 1_020 * MS) == ["tick 1020000000"]


@pytest.fixture
def listener(monkeypatch):
    """A listener, and how a process connects to it that says `greeting`."""
    monkeypatch.setattr("perch_sim.lockstep.link._RECEIVE_LIMIT", struct.pack("ll", 0, 50_000))
    where = address("test", f"{os.getpid()}")
    made, clients = ParticipantListener(where), []

    def connect(greeting: bytes):
        clients.append(sockets.Client(where, "AF_UNIX"))
        clients[-1].send_bytes(greeting)
        return clients[-1]

    yield made, connect
    made.close()
    for client in clients:
        client.close()


@pytest.mark.parametrize("begun", [b"\0\0", struct.pack("!i", 100) + b"the rest never comes"])
def test_a_participant_that_stops_within_a_message_is_not_waited_for(listener, begun):
    vehicle, connect = listener
    participant = connect(b'{"node": "vio", "inputs": []}')
    [(name, _, connection)] = vehicle.accept()
    os.write(participant.fileno(), begun)
    ended = []

    def read():
        try:
            receive(connection)
        except OSError as error:
            ended.append(error)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    reader.join(60.0)
    assert name == "vio" and [type(error) for error in ended] == [BlockingIOError]


def test_an_image_is_sent_at_once_to_a_participant_that_reads_it_later(listener):
    vehicle, connect = listener
    participant = connect(b'{"node": "vio", "inputs": []}')
    [(_, _, connection)] = vehicle.accept()
    sender = NonBlockingSender(connection)
    sender.send(bytes(640 * 480))
    assert not sender._unsent and participant.recv_bytes() == bytes(640 * 480)
    sender.close()


def test_a_message_is_read_whole_by_one_call_unless_it_is_large(listener, monkeypatch):
    vehicle, connect = listener
    participant, calls, rest, read = connect(b'{"node": "vio", "inputs": []}'), [], [], os.read
    [(_, _, connection)] = vehicle.accept()

    def counted(*arguments):
        """Reads; then the next part of what the participant says is there."""
        calls.append(1)
        data = read(*arguments)
        if rest:
            os.write(participant.fileno(), rest.pop(0))
        return data

    monkeypatch.setattr("os.read", counted)
    for size in (0, 1000):
        participant.send_bytes(bytes(size))
        assert receive(connection) == bytes(size)
    assert len(calls) == 2
    participant.send_bytes(bytes(100_000))
    assert receive(connection) == bytes(100_000)
    rest += [b"\0\3", b"a", b"bc"]
    os.write(participant.fileno(), b"\0\0")
    assert receive(connection) == b"abc"
    participant.send_bytes(b"one"), participant.send_bytes(b"two")
    with pytest.raises(PerchError, match="more than one message"):
        receive(connection)
    participant.close()
    with pytest.raises(EOFError):
        receive(connection)


def test_a_message_of_nonsense_length_is_not_given_memory(listener, monkeypatch):
    vehicle, connect = listener
    participant, sizes, read = connect(b'{"node": "vio", "inputs": []}'), [], os.read
    [(_, _, connection)] = vehicle.accept()
    monkeypatch.setattr("os.read", lambda file, size: sizes.append(size) or read(file, min(size, 1000)))
    os.write(participant.fileno(), struct.pack("!i", (1 << 31) - 1) + b"nonsense")
    with pytest.raises(BlockingIOError):
        receive(connection)
    assert max(sizes) <= 1 << 20


@pytest.mark.parametrize("greeting", [b"", b"\xff", b"3", b"{}", b'{"node": "vio", "inputs": 3}', b"[" * 60_000])
def test_who_greets_with_nonsense_is_no_participant(listener, greeting):
    vehicle, connect = listener
    connect(greeting)
    assert vehicle.accept() == []


def test_bytes_for_the_vehicle_that_are_no_message_are_refused_and_the_flight_goes_on():
    class Codec:
        def decode(self, channel, data):
            if not data:
                raise PerchError("not a whole command")
            return tuple(data)

    class Remote(LocalParticipant):
        def results(self):
            return [Packet.received("motor_command", data, Codec()) for data in (b"", b"\1\2")] if super().results() is not None else None

    vehicle, lines = Vehicle(), []
    vehicle.log.receivers.append(lines.append)
    schedule = Schedule(vehicle, [Remote(Estimator())], tasks(10, 10))
    assert schedule.advance() and schedule.advance()
    assert vehicle.commands == [(STEP, (1, 2)), (2 * STEP, (1, 2))]
    assert [(line.level, line.text) for line in lines] == [("warning", "motor_command refused: not a whole command")] * 2


def test_a_value_that_has_no_message_is_left_out_of_a_batch_and_named():
    class Codec:
        def encode(self, channel, value):
            if value < 0:
                raise ValueError("below zero")
            return bytes([value])

    failures = []
    data = pack(5, [Packet("number", value, Codec()) for value in (1, -1, 2)], lambda channel, error: failures.append((channel, str(error))))
    assert [packet.data for packet in unpack(data, None)[1]] == [b"\1", b"\2"] and failures == [("number", "below zero")]


class Failing(Component[Nothing]):
    number, said = Input(int, "number"), Output(str, "said")
    tick = Timer(0.02)

    def on_number(self, number):
        self.said(f"{12 // number}")

    def on_tick(self, now):
        self.said(f"tick {now}")


def test_behind_a_packet_that_a_component_fails_on_the_batch_goes_on():
    failing = LocalParticipant(Failing(Nothing()))
    with pytest.raises(ZeroDivisionError):
        said(failing, 0, 3, 0, 4, 0, 6)
    with pytest.raises(ZeroDivisionError):
        failing.results()
    assert [packet.value for packet in failing.results()] == ["4", "3", "2", "tick 0"]
    assert said(failing, 20 * MS, 12) == ["1", "tick 20000000"]
