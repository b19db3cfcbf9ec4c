"""The vehicle's side of the lockstep: when a step may be published, and what it releases. Pure, without ROS or clocks.

A slow participant is *triggered* by an image or a tick; its result is *due* at a later simulation time. The step at
which it is due is held back until the participant has reported that very trigger, and then releases what the
participant had published by then. See docs/architecture.md, "Lockstep".
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Mapping

Counts = Mapping[str, int]  # topic -> messages published so far


@dataclass
class _Slow:
    """A slow participant."""

    greeted: bool = False
    reported: bool = False  # has finished some work
    dropped: bool = False
    topics: dict[str, int] = field(default_factory=dict)           # released so far
    due: deque[tuple[int, int]] = field(default_factory=deque)     # (trigger, when its result counts), in order
    reports: dict[int, dict[str, int]] = field(default_factory=dict)


class LockstepMaster:
    """Knows what was triggered, what has been reported, and what a step has to wait for. Times in nanoseconds."""

    def __init__(self, slow: tuple[str, ...], controller: bool) -> None:
        """
        Args:
            slow: names of the slow participants.
            controller: whether each step waits for a motor command with its stamp.
        """
        self._slow = {name: _Slow() for name in slow}
        self._controller = controller
        self._awaited: int | None = None   # stamp of the step whose command is missing
        self._announced: dict[str, int] = {}

    # -- arrivals ----------------------------------------------------------------------------------------------------

    def report(self, node: str, trigger: int, published: Counts) -> bool:
        """A participant's report; one with trigger 0 is its greeting.

        Returns:
            Whether the participant had been dropped and is taken back.

        Raises:
            KeyError: the node is not a participant of this run.
        """
        slow = self._slow[node]
        returned, slow.dropped = slow.dropped, False
        if trigger == 0:
            slow.greeted = True
            for topic in published:
                slow.topics.setdefault(topic, 0)
            return returned
        slow.greeted = slow.reported = True
        if any(trigger == expected for expected, _ in slow.due):
            slow.reports[trigger] = dict(published)
        return returned

    def command(self, stamp: int) -> bool:
        """A motor command with the stamp of the step that it answers.

        Returns:
            Whether it is the one that was waited for.
        """
        if self._awaited is not None and stamp == self._awaited:
            self._awaited = None
            return True
        return False

    def trigger(self, node: str, trigger: int, due: int) -> None:
        """Work has been given to a participant; its result counts from `due` on."""
        slow = self._slow[node]
        if not slow.dropped:
            slow.due.append((trigger, due))

    def cancel(self, node: str, trigger: int) -> None:
        """Expect no result of work that cannot be done: its image is lost."""
        slow = self._slow[node]
        slow.due = deque(entry for entry in slow.due if entry[0] != trigger)

    # -- steps -------------------------------------------------------------------------------------------------------

    def missing_greetings(self) -> tuple[str, ...]:
        """Participants that have not greeted yet."""
        return tuple(name for name, slow in self._slow.items() if not (slow.greeted or slow.dropped))

    def missing_results(self, stamp: int) -> tuple[str, ...]:
        """Participants whose result is due at the step `stamp` and has not come: the step has to wait for them."""
        return tuple(name for name, slow in self._slow.items()
                     if any(due <= stamp and trigger not in slow.reports for trigger, due in slow.due))

    @property
    def missing_command(self) -> bool:
        """Whether the present step waits for its motor command."""
        return self._awaited is not None

    @property
    def led(self) -> bool:
        """Whether steps wait for motor commands at all."""
        return self._controller

    def has_reported(self, node: str) -> bool:
        """Whether a participant has finished any work in this run."""
        return self._slow[node].reported

    def begin(self, stamp: int) -> dict[str, int]:
        """Begin the step `stamp`: nothing that is due is missing any more.

        Returns:
            What the step has to name as released: every topic at the first step, later those that changed.

        Raises:
            RuntimeError: the step before has no command yet, or a result that is due is missing.
        """
        missing = self.missing_results(stamp)
        if missing or self._awaited is not None:
            raise RuntimeError(f"step {stamp} begun without {', '.join(missing) or 'the command before it'}")
        released = {}
        for slow in self._slow.values():
            while slow.due and slow.due[0][1] <= stamp:
                for topic, count in slow.reports.pop(slow.due.popleft()[0]).items():
                    slow.topics[topic] = max(count, slow.topics.get(topic, 0))
            for topic, count in slow.topics.items():
                if self._announced.get(topic) != count:
                    self._announced[topic] = released[topic] = count
        if self._controller:
            self._awaited = stamp
        return released

    # -- the silent --------------------------------------------------------------------------------------------------

    def drop(self, node: str) -> None:
        """Go on without a slow participant until it reports again."""
        slow = self._slow[node]
        slow.dropped = True
        slow.due.clear()
        slow.reports.clear()

    def drop_controller(self) -> None:
        """Go on without motor commands until one comes again."""
        self._controller, self._awaited = False, None

    def take_back_controller(self) -> None:
        """Wait for motor commands again, from the next step on."""
        self._controller = True
