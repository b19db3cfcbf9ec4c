"""The flight loop: the vehicle and its participants in one process, step by step, by the schedule of every simulated flight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from perch_core.component import Component
from perch_core.errors import PerchError
from perch_core.processes import single_threaded_blas
from perch_core.values import PerchGoal, PerchResult, seconds
from perch_eval.in_process.trace import FlightTrace
from perch_sim.lockstep import LocalParticipant, Packet, Schedule, Task, local_servers

Filter = Callable[[int, Any], Any]
"""(stamp of the step [ns], value) -> what arrives instead; None: nothing."""


class SentGoal:
    """A goal of the mission as whoever sent it sees it.

    Attributes:
        value: what is asked for.
        cancel_requested: it shall end.
        result: how it ended; None: it has not.
    """

    def __init__(self, value: PerchGoal, told: Callable[[Any], None]) -> None:
        self.value, self.feedback = value, told
        self.cancel_requested = False
        self.result: PerchResult | None = None

    def finish(self, ending: str, result: PerchResult) -> None:
        """It has ended."""
        self.result = result


class _Reached(LocalParticipant):
    """A participant whose inputs can be disturbed on their way."""

    def __init__(self, component: Component[Any], filters: Mapping[tuple[str, str], Filter], **options: Any) -> None:
        super().__init__(component, **options)
        self._filters = filters

    def begin(self, now: int, batch: Sequence[Packet]) -> None:
        """Work on what arrives of a batch."""
        if self._filters:
            mine = {channel: change for (name, channel), change in self._filters.items() if name == self.name}
            changed = [Packet(p.channel, mine[p.channel](now, p.value)) if p.channel in mine else p for p in batch]
            batch = [packet for packet in changed if packet.value is not None]
        super().begin(now, batch)


class Loop:
    """A flight in the making; `step` is one control period.

    Attributes:
        vehicle: the component that owns time.
        components: name -> participant's component.
        trace: what has been emitted.
        filters: (name of the receiver, channel) -> what becomes of the values on their way; may be changed at any time.
    """

    def __init__(self, vehicle: Component[Any], components: Mapping[str, Component[Any]], tasks: Mapping[str, Task],
                 servers: Mapping[str, Component[Any]]) -> None:
        """
        Args:
            vehicle: owns time; see `perch_sim.lockstep.Schedule`.
            components: name -> component.
            tasks: when each works, in order.
            servers: components that only answer requests: planners.

        Raises:
            PerchError: a component has no task.
        """
        single_threaded_blas()
        self.vehicle: Any = vehicle
        self.components: dict[str, Any] = {**components, **servers}
        self.filters: dict[tuple[str, str], Filter] = {}
        self.trace = FlightTrace()
        asked = {name: LocalParticipant(server, name=name) for name, server in servers.items()}
        ask = local_servers(asked.values())
        members = {name: _Reached(component, self.filters, ask=ask, name=name) for name, component in components.items()}
        self._participants = asked | members
        self._schedule = Schedule(vehicle, members.values(), tasks)
        for component in (vehicle, *self.components.values()):
            self.trace.tap(component)

    @property
    def time(self) -> float:
        """Of the present step [s]."""
        return seconds(self._schedule.now)

    def step(self) -> int:
        """One control period.

        Returns:
            Its stamp [ns].

        Raises:
            PerchError: it waits for something, which here can never come.
        """
        if not self._schedule.advance():
            raise PerchError(f"the flight waits for {', '.join(f'{owed.what} of {owed.name}' for owed in self._schedule.owed())}")
        return self._schedule.now

    def request(self, name: str, port: str, request: Any) -> Any:
        """Ask a service of a component, in front of its next batch.

        Returns:
            A list that gets the answer.
        """
        answers: list[Any] = []
        self._participants[name].request(port, request, answers.append)
        return answers

    def send(self, name: str, goal: PerchGoal) -> SentGoal:
        """Send a goal to the mission; its phases go into the trace."""
        def told(feedback: Any) -> None:
            now = (feedback.phase, feedback.message)
            if not self.trace.phases or self.trace.phases[-1][1:] != now:
                self.trace.phases.append((self.time, *now))

        sent = SentGoal(goal, told)
        self._participants[name].goal("perch", sent)
        return sent

    def close(self) -> None:
        """Free what the components hold."""
        for component in (self.vehicle, *self.components.values()):
            component.close()
