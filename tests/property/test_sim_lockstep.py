"""The vehicle's side of the lockstep under random schedules: nothing counts early, nothing waits for ever."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st
from perch_core.errors import ConfigError
from perch_core.scenario import Latency
from perch_sim.lockstep_master import LockstepMaster
from perch_sim.pacing import LONGEST_CATCH_UP, Pacing
from perch_sim.participants import triggers

PERIOD = 2


@dataclass
class Worker:
    """A slow participant that finishes work in order, whenever the schedule lets it."""

    name: str
    latency: int
    every: int
    queue: list[int] = field(default_factory=list)
    published: int = 0
    finished: dict[int, int] = field(default_factory=dict)  # trigger -> count at its report


class Play:
    """A flight of the master against workers, with the events in an order that the test chooses."""

    def __init__(self, workers: list[Worker]) -> None:
        self.master = LockstepMaster(tuple(w.name for w in workers), controller=True)
        self.workers, self.time, self.index = workers, PERIOD, 0
        self.visible: dict[str, list[int]] = {w.name: [] for w in workers}
        self.triggered: dict[str, list[tuple[int, int]]] = {w.name: [] for w in workers}
        self.seen = {w.name: 0 for w in workers}
        for worker in workers:
            self.master.report(worker.name, 0, {f"/{worker.name}": 0})

    def try_step(self) -> bool:
        """Publish the next step if the master allows it."""
        if self.master.missing_command or self.master.missing_results(self.time):
            return False
        for worker in self.workers:
            if self.index % worker.every == 0:
                self.master.trigger(worker.name, self.time, self.time + worker.latency)
                self.triggered[worker.name].append((self.time, self.time + worker.latency))
                worker.queue.append(self.time)
        for topic, count in self.master.begin(self.time).items():
            self.seen[topic[1:]] = count
        for worker in self.workers:
            self.visible[worker.name].append(self.seen[worker.name])
        return True

    def answer(self) -> bool:
        """The controller answers the present step, and physics goes on."""
        if not self.master.missing_command:
            return False
        assert self.master.command(self.time)
        self.time, self.index = self.time + PERIOD, self.index + 1
        return True

    def work(self, worker: Worker, results: int) -> bool:
        """A participant finishes its oldest work with so many messages."""
        if not worker.queue:
            return False
        trigger = worker.queue.pop(0)
        worker.published += results
        worker.finished[trigger] = worker.published
        self.master.report(worker.name, trigger, {f"/{worker.name}": worker.published})
        return True


WORKERS = st.lists(st.tuples(st.integers(1, 30), st.integers(1, 6)), min_size=1, max_size=4)


@given(WORKERS, st.lists(st.integers(0, 9), min_size=50, max_size=300))
def test_results_count_exactly_from_when_they_are_due(kinds, schedule):
    """Whatever the order of events, step by step each consumer sees what a list of dues says, no more and no less."""
    play = Play([Worker(f"w{i}", latency, every) for i, (latency, every) in enumerate(kinds)])
    for choice in schedule:
        worker = play.workers[choice % len(play.workers)]
        if choice < 4:
            play.work(worker, results=choice % 3)
        elif choice < 7:
            play.answer()
        else:
            play.try_step()
    for worker in play.workers:
        for index, seen in enumerate(play.visible[worker.name]):
            now = PERIOD * (index + 1)
            due = [worker.finished[trigger] for trigger, when in play.triggered[worker.name] if when <= now]
            assert seen == (due[-1] if due else 0)


@given(WORKERS, st.lists(st.integers(0, 100), min_size=20, max_size=100))
def test_it_never_deadlocks(kinds, picks):
    """While workers work and the controller answers, time goes on: some event is always possible."""
    play = Play([Worker(f"w{i}", latency, every) for i, (latency, every) in enumerate(kinds)])
    for pick in picks:
        events = [play.try_step, play.answer] + [lambda w=w: play.work(w, 1) for w in play.workers]
        first = pick % len(events)
        assert any(event() for event in events[first:] + events[:first])
    steps = play.index
    for _ in range(10 * len(play.workers) + 10):
        for event in [play.try_step, play.answer] + [lambda w=w: play.work(w, 1) for w in play.workers]:
            event()
    assert play.index > steps


def test_first_step_names_every_topic_and_later_ones_what_changed():
    master = LockstepMaster(("vio", "mission"), controller=False)
    assert master.missing_greetings() == ("vio", "mission")
    master.report("vio", 0, {"/vio/odometry": 0})
    master.report("mission", 0, {"/trajectory": 0, "/controller/command": 0})
    assert master.missing_greetings() == ()
    assert master.begin(2) == {"/vio/odometry": 0, "/trajectory": 0, "/controller/command": 0}
    master.trigger("mission", 2, 6)
    assert master.begin(4) == {}
    assert master.missing_results(6) == ("mission",)
    master.report("mission", 2, {"/trajectory": 1, "/controller/command": 0})
    assert master.begin(6) == {"/trajectory": 1}


def test_a_step_cannot_begin_early():
    master = LockstepMaster(("vio",), controller=True)
    master.trigger("vio", 2, 4)
    master.begin(2)
    with pytest.raises(RuntimeError, match="command"):
        master.begin(3)
    assert not master.command(1) and master.command(2)
    with pytest.raises(RuntimeError, match="vio"):
        master.begin(4)


def test_a_late_greeting_is_no_report():
    """Participants greet until they see a step: a greeting on its way then must not pass for finished work."""
    master = LockstepMaster(("mission",), controller=False)
    master.report("mission", 0, {"/trajectory": 0})
    master.trigger("mission", 2, 4)
    master.begin(2)
    master.report("mission", 0, {"/trajectory": 0})
    assert master.missing_results(4) == ("mission",)


def test_reports_beyond_what_was_triggered_change_nothing():
    master = LockstepMaster(("mission",), controller=False)
    master.trigger("mission", 2, 6)
    master.report("mission", 4, {"/trajectory": 7})
    master.report("mission", 2, {"/trajectory": 1})
    assert master.begin(6) == {"/trajectory": 1}
    with pytest.raises(KeyError):
        master.report("stranger", 2, {})


def test_the_dropped_are_not_waited_for_until_they_are_back():
    master = LockstepMaster(("vio",), controller=True)
    master.trigger("vio", 2, 4)
    master.begin(2)
    master.drop("vio")
    master.drop_controller()
    assert not master.missing_command and master.missing_results(4) == ()
    master.begin(4)
    master.trigger("vio", 4, 8)
    assert master.missing_results(8) == ()
    assert master.report("vio", 2, {"/vio/odometry": 1})
    master.take_back_controller()
    master.trigger("vio", 6, 8)
    master.begin(6)
    assert master.missing_command and master.missing_results(8) == ("vio",)


def test_unknown_participants_are_refused_with_those_there_are():
    with pytest.raises(ConfigError, match="participants: 'vi0' is not one of controller, vio, vio_model"):
        triggers(("vi0",), Latency())
    assert [t.node for t in triggers(("controller", "mission", "vio"), Latency())] == ["mission", "vio"]


@given(st.lists(st.integers(0, 200), min_size=1, max_size=60))
def test_pacing_keeps_up_with_the_clock_or_says_what_it_gave_up(waits):
    period, now, done = 10, 1000, 0
    pacing = Pacing(period, now)
    for wait in waits:
        now += wait
        due = pacing.due(now)
        assert 0 <= due <= LONGEST_CATCH_UP
        done += due
        assert done + pacing.skipped == (now - 1000) // period  # every period is done or owned up to
        assert now < pacing.next_due <= now + period
    assert pacing.misses >= pacing.skipped
