"""Flight loop in one process: the vehicle and its participants, step by step, by the schedule of every simulated flight."""

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
"""(stamp of the step [ns], value) -> value that is received instead; None: it is dropped."""


class SentGoal:
    """Handle of a goal that was sent to the mission.

    Attributes:
        value: the goal.
        feedback: called with the mission's feedback.
        cancel_requested: whether the goal is to be cancelled; set by the sender.
        result: result of the goal; None: it has not ended.
    """

    def __init__(self, value: PerchGoal, on_feedback: Callable[[Any], None]) -> None:
        self.value, self.feedback = value, on_feedback
        self.cancel_requested = False
        self.result: PerchResult | None = None

    def finish(self, ending: str, result: PerchResult) -> None:
        """Store the result when the goal has ended."""
        self.result = result


class _FilteredParticipant(LocalParticipant):
    """Participant whose inputs can be disturbed."""

    def __init__(self, component: Component[Any], filters: Mapping[tuple[str, str], Filter], **options: Any) -> None:
        super().__init__(component, **options)
        self._filters = filters

    def begin(self, now: int, batch: Sequence[Packet]) -> None:
        """Process a batch after its values have passed the filters."""
        if self._filters:
            filters = {channel: change for (name, channel), change in self._filters.items() if name == self.name}
            changed = [Packet(p.channel, filters[p.channel](now, p.value)) if p.channel in filters else p for p in batch]
            batch = [packet for packet in changed if packet.value is not None]
        super().begin(now, batch)


class Loop:
    """Flight in progress; `step` advances it by one control period.

    Attributes:
        vehicle: component that determines the time.
        components: name -> component of the participant or server.
        trace: values emitted so far.
        filters: (name of the receiver, channel) -> filter of the values on that channel; may be changed at any time.
    """

    def __init__(self, vehicle: Component[Any], components: Mapping[str, Component[Any]], tasks: Mapping[str, Task],
                 servers: Mapping[str, Component[Any]]) -> None:
        """
        Args:
            vehicle: determines the time; see `perch_sim.lockstep.Schedule`.
            components: name -> component.
            tasks: schedule of each component, in the order of execution.
            servers: components that only answer requests: planners.

        Raises:
            PerchError: a component has no task.
        """
        single_threaded_blas()
        self.vehicle: Any = vehicle
        self.components: dict[str, Any] = {**components, **servers}
        self.filters: dict[tuple[str, str], Filter] = {}
        self.trace = FlightTrace()
        server_participants = {name: LocalParticipant(server, name=name) for name, server in servers.items()}
        self._send_request = local_servers(server_participants.values())
        members = {name: self._member(name, component) for name, component in components.items()}
        self._participants = server_participants | members
        self._schedule = Schedule(vehicle, members.values(), tasks)
        for component in (vehicle, *self.components.values()):
            self.trace.tap(component)

    def _member(self, name: str, component: Component[Any]) -> _FilteredParticipant:
        return _FilteredParticipant(component, self.filters, send_request=self._send_request, name=name)

    def restart(self, name: str, component: Component[Any]) -> None:
        """Replace a component in flight by a new one, as when its node is killed and started again."""
        self.components[name].close()
        self.components[name], self._participants[name] = component, self._member(name, component)
        self.trace.tap(component)
        self._schedule.join(self._participants[name])

    @property
    def time(self) -> float:
        """Simulation time of the present step [s]."""
        return seconds(self._schedule.now)

    def step(self) -> int:
        """Advance by one control period.

        Returns:
            Stamp of the step [ns].

        Raises:
            PerchError: the schedule waits for a result; in one process it can never arrive.
        """
        if not self._schedule.advance():
            raise PerchError(f"the flight waits for {', '.join(f'{missing.what} of {missing.name}' for missing in self._schedule.pending())}")
        return self._schedule.now

    def request(self, name: str, port: str, request: Any) -> Any:
        """Call a service of a component; it is executed before the component's next batch.

        Returns:
            A list to which the answer is appended.
        """
        answers: list[Any] = []
        self._participants[name].request(port, request, answers.append)
        return answers

    def send(self, name: str, goal: PerchGoal) -> SentGoal:
        """Send a goal to the mission; its phases are added to the trace."""
        def on_feedback(feedback: Any) -> None:
            now = (feedback.phase, feedback.message)
            if not self.trace.phases or self.trace.phases[-1][1:] != now:
                self.trace.phases.append((self.time, *now))

        sent = SentGoal(goal, on_feedback)
        self._participants[name].goal("perch", sent)
        return sent

    def close(self) -> None:
        """Release the resources of the components."""
        for component in (self.vehicle, *self.components.values()):
            component.close()
