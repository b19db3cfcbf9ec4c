"""Participants of a flight: batches of packets in, packets out. `LocalParticipant` is a component in this process."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

from perch_core.component import Action, Client, Component, Input, Output, Service, Unavailable, Timer, ports
from perch_core.errors import PerchError
from perch_core.job import run_now
from perch_core.values import NANOSECONDS, Serialized
from perch_sim.lockstep.packet import Codec, Packet
from perch_sim.lockstep.tasks import START_DEADLINE


class Participant(Protocol):
    """Participant of a flight, in this process or another.

    Attributes:
        name: name of its task in the schedule.
        inputs: channels of its inputs.
    """

    name: str
    inputs: frozenset[str]

    def begin(self, now: int, batch: Sequence[Packet]) -> None:
        """Begin to work on a batch; the previous batch must be finished.

        Args:
            now: stamp of the step at which the batch was closed [ns].
            batch: packets in order.
        """

    def results(self) -> list[Packet] | None:
        """Return the packets from the batch, in the order of emission, once; None while the work continues. Never blocks."""

    def set_channel_filter(self, is_taken: Callable[[str], bool]) -> None:
        """Set the check whether a channel has a receiver; packets without one need not be emitted."""


class Future(Protocol):
    """An answer that may be pending, such as `concurrent.futures.Future` or rclpy's."""

    def done(self) -> bool:
        """Return whether the answer has arrived."""

    def result(self) -> Any:
        """Return the answer; raises the exception of a failed request."""


SendRequest = Callable[[str, Any], Future]  # (channel of the service, request)


class Answer:
    """An answer that is set by a call; calls after the first are ignored."""

    def __init__(self) -> None:
        self._done, self._value = False, None

    def __call__(self, value: Any) -> None:
        if not self._done:
            self._done, self._value = True, value

    def done(self) -> bool:
        """Return whether the answer has arrived."""
        return self._done

    def result(self) -> Any:
        """Return the answer."""
        return self._value


class _Awaited(NamedTuple):
    """Answer to a request of a component: it is passed to `take` in the first batch from `due` [ns] on."""

    due: int
    take: Callable[[Any], None]
    answer: Future


class Emissions:
    """Collects the outputs of a component as packets, except log lines and diagnostics: add receivers to these ports."""

    def __init__(self, component: Component[Any], codec: Codec | None = None) -> None:
        self._packets: list[Packet] = []
        self._receivers = []
        for port in ports(type(component), Output):
            if port not in (Component.log, Component.diagnostics):
                channel = port.channel(component)
                self._receivers.append((channel, getattr(component, port.name).receivers, self._receiver(channel, codec)))
        self.set_channel_filter(lambda channel: True)

    def _receiver(self, channel: str, codec: Codec | None) -> Callable[[Any], None]:
        append = self._packets.append
        return lambda value: append(Packet(channel, value, codec))

    def set_channel_filter(self, is_taken: Callable[[str], bool]) -> None:
        """Collect the channels for which `is_taken` returns True, and no others."""
        for channel, receivers, receive in self._receivers:
            if (receive in receivers) != is_taken(channel):
                receivers.append(receive) if is_taken(channel) else receivers.remove(receive)

    def take(self) -> list[Packet]:
        """Return the packets emitted since the last call."""
        packets = self._packets.copy()
        self._packets.clear()
        return packets


def handlers(component: Component[Any]) -> dict[str, Callable[[Any], None]]:
    """Return the handler of each input channel of a component.

    Raises:
        PerchError: two inputs have the same channel.
    """
    found: dict[str, Callable[[Any], None]] = {}
    for port in ports(type(component), Input):
        channel = port.channel(component)
        if channel in found:
            raise PerchError(f"{type(component).__name__}: two inputs take {channel!r}")
        found[channel] = port.handler(component)
    return found


def packet_receiver(component: Component[Any], handle: Callable[[Any], None]) -> Callable[[Packet], None]:
    """Return a receiver of packets for a handler; bytes that are no message are refused with a warning."""
    def receive(packet: Packet) -> None:
        try:
            value = packet.value
        except PerchError as error:
            component.warn(f"{packet.channel} refused: {error}", min_interval=1.0)
        else:
            handle(value)

    return receive


class LocalParticipant(Participant):
    """A component in this process, which processes a batch when it begins.

    The batch is finished at once, unless a due answer to one of the component's own requests is missing, or the first batch waits
    for a goal. Where there is a codec, inputs of `Serialized` receive the packets' bytes, most of which exist already.

    Attributes:
        now: stamp of the newest batch [ns]; 0 before the first.
    """

    def __init__(self, component: Component[Any], codec: Codec | None = None, send_request: SendRequest | None = None,
                 await_goal: str = "", *, name: str = "") -> None:
        """
        Args:
            component: component, which must have no other host; its jobs run at once.
            codec: codec of its packets; None: they never leave this process.
            send_request: sends the component's requests to their servers; None: there are no servers.
            await_goal: name of an action: the flight begins with its first goal, unless the participant joins a flight under way.
            name: name of its task in the schedule; empty: that of the class, in lower case with underscores.

        Raises:
            PerchError: two inputs have the same channel, or `await_goal` is not an action.
        """
        kind = type(component)
        self.component, self.name = component, name or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind.__name__).lower()
        self._handlers = handlers(component)
        self._serialized = {port.channel(component) for port in ports(kind, Input) if codec is not None and port.value is Serialized}
        self.inputs = frozenset(self._handlers)
        self._emissions = Emissions(component, codec)
        self._send_request = send_request or local_servers(())
        self._timers: list[list[Any]] = [[0, round(port.period * NANOSECONDS), port.handler(component)] for port in ports(kind, Timer)]
        self._external_calls: deque[Callable[[], None]] = deque()  # requests and goals, in front of the next batch
        self._awaited: list[_Awaited] = []
        self.now, self._begun = 0, False
        self._batch: Iterator[Packet] | None = None  # what is left of it
        self._await_goal = await_goal
        if await_goal and await_goal not in (port.name for port in ports(kind, Action)):
            raise PerchError(f"{self.name}: {await_goal!r} is not one of its actions")
        component.work = run_now
        for port in ports(kind, Client):
            setattr(component, port.name, self._client(port))

    # -- batches -----------------------------------------------------------------------------------------------------

    def begin(self, now: int, batch: Sequence[Packet]) -> None:
        """Process a batch, or wait for the goal or the answers that it needs; in a new flight, for all answers of the old one."""
        if now > START_DEADLINE:
            self._await_goal = ""
        if now < self.now:  # the vehicle has been started again
            for timer in self._timers:
                timer[0] = 0
            self._awaited = [awaited._replace(due=0) for awaited in self._awaited]
        self.now, self._batch, self._begun = now, iter(batch), True
        self._continue_batch()

    def results(self) -> list[Packet] | None:
        """Return the packets from the batch; None while it waits for an answer or its first goal."""
        if self._batch is not None:
            self._continue_batch()
            if self._batch is not None:
                return None
        return self._emissions.take()

    def set_channel_filter(self, is_taken: Callable[[str], bool]) -> None:
        """Emit only on channels for which `is_taken` returns True."""
        self._emissions.set_channel_filter(is_taken)

    def _continue_batch(self) -> None:
        if self._external_calls or self._awaited or self._await_goal:
            if self._await_goal or not all(awaited.answer.done() for awaited in self._awaited if awaited.due <= self.now):
                return
            self._deliver_pending()
        now, handle = self.now, self._handlers
        for packet in self._batch or ():  # if the component fails on one, the next call continues behind it
            handle[packet.channel](packet.data if packet.channel in self._serialized else packet.value)
        for timer in self._timers:
            if now >= timer[0]:
                timer[0] = timer[0] + timer[1] if timer[0] + timer[1] > now else now + timer[1]
                timer[2](now)
        self._batch = None

    def _deliver_pending(self) -> None:
        while self._external_calls:
            self._external_calls.popleft()()
        for awaited in [awaited for awaited in self._awaited if awaited.due <= self.now]:
            self._awaited.remove(awaited)  # one by one: if the component fails on one, the others remain
            try:
                answer = awaited.answer.result()
            except Exception as error:  # any failure of a server
                answer = Unavailable(f"{type(error).__name__}: {error}")
            awaited.take(answer)

    # -- requests ----------------------------------------------------------------------------------------------------

    def request(self, port_name: str, request: Any, reply: Callable[[Any], None]) -> None:
        """Pass a request to a service of the component, in front of the next batch; before the first batch, at once."""
        handler = self._port(Service, port_name).handler(self.component)
        self.enter(port_name, lambda: handler(request, reply))

    def goal(self, port_name: str, goal: Any, answered: Callable[[str], None] | None = None) -> None:
        """Pass a goal to an action of the component, as `request` does.

        Args:
            port_name: name of the action's port.
            goal: a `perch_core.component.Goal`.
            answered: called with the reason for a rejection, or an empty string.
        """
        handler = self._port(Action, port_name).handler(self.component)

        def deliver() -> None:
            rejected = handler(goal)
            if answered is not None:
                answered(rejected)

        self.enter(port_name, deliver)

    def enter(self, port_name: str, call: Callable[[], None]) -> None:
        """Schedule a call that passes a request or a goal to the port, as `request` does."""
        if port_name == self._await_goal:
            self._await_goal = ""
        if self._begun:
            self._external_calls.append(call)
        else:
            call()

    def serves(self, channel: str) -> str | None:
        """Return the name of the service with this channel, or None."""
        return next((port.name for port in ports(type(self.component), Service) if port.channel(self.component) == channel), None)

    def _port(self, kind: type, name: str) -> Any:
        for port in ports(type(self.component), kind):  # type: ignore[var-annotated]  # of whatever kind
            if port.name == name:
                return port
        raise PerchError(f"{self.name}: {name!r} is not one of its ports of type {kind.__name__}")

    def _client(self, port: Client[Any, Any]) -> Callable[..., None]:
        channel, take = port.channel(self.component), port.handler(self.component)

        def send(request: Any, due: int = 0) -> None:
            self._awaited.append(_Awaited(due, partial(take, request), self._send_request(channel, request)))

        return send


def local_servers(servers: Iterable[LocalParticipant]) -> SendRequest:
    """Return a function that sends requests to components in this process."""
    participants = list(servers)

    def send_request(channel: str, request: Any) -> Future:
        answer = Answer()
        for server in participants:
            name = server.serves(channel)
            if name is not None:
                server.request(name, request, answer)
                return answer
        answer(Unavailable(f"no server for {channel!r}"))
        return answer

    return send_request
