"""Lockstep host: a node whose inputs are ordered by the simulator's schedule.

Component, outputs, services and actions are the same as in the arrival host. The inputs are sent by the vehicle's node: as values
within one process, otherwise as batches of serialised messages over a local socket. Outputs return the same way, and are
also published on their topics. Messages of nodes outside the lockstep are ignored, except on topics that are only recorded.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from perch_core.component import Action, Component, Input, Service, ports
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.ros.service_clients import Send, connect_clients, server_names
from perch_core.ros.component_node import ComponentNode
from perch_core.ros.intake import Intake
from perch_core.ros.priority import priority
from perch_core.ros.wiring import Wiring
from perch_core.values import Serialized
from perch_sim.lockstep import Answer, LocalParticipant, Packet, is_slow
from perch_sim.lockstep.link import ConnectionPoll, address, connect_to_vehicle, pack, receive, unpack
from rclpy.clock import Clock, ClockType

CONNECT_PERIOD = 0.1   # between attempts to connect to the vehicle [s]
CHECK_PERIOD = 0.005   # between checks whether an unfinished batch can continue [s]
REQUEST_PERIOD = 0.5   # between checks of open requests [s]
POLL_TIMEOUT = 0.01    # wait for a batch before other events are processed [s]
WARN_AFTER = 3.0       # a vehicle that is missing, or a server that has not answered, for so long is reported [s]
WARN_REPEAT = 10.0     # between reports of a missing vehicle [s]
BURST = 40             # batches between which other events are processed
UNTAKEN = ("vio/debug_image",)  # outputs that no participant takes: each value would be drawn and sent for nobody
OBSERVED = ("/diagnostics", "/tf", "/tf_static", "robot_description")  # taken on arrival by components that only store messages


@dataclass
class _OpenRequest:
    """A request without an answer: its service, when it was sent (monotonic clock) [s], and its server once it is overdue."""

    channel: str
    answer: Answer
    since: float
    overdue: str = ""


class ParticipantNode(ComponentNode):
    """Node with one component that takes part in the lockstep."""

    def __init__(self, name: str, component: type[Component], wiring: Wiring, **kwargs: Any) -> None:
        """
        Args:
            name, component, wiring, kwargs: as in `ComponentNode`.
        """
        super().__init__(name, component, wiring, **kwargs)
        await_goal = self.declare_parameter("lockstep_hold", "").value
        self.declare_parameter("lockstep", True)
        self.participant = LocalParticipant(self.component, codec=topics, send_request=self._send_request,
                                            await_goal=await_goal, name=name)
        self.participant.begin = partial(self.guarded, "step", self.participant.begin)  # type: ignore[method-assign]
        self.participant.results = partial(self._results, self.participant.results)  # type: ignore[method-assign]
        self._observed = [port for port in ports(component, Input) if port.channel(self.component) in OBSERVED and port.value is Serialized]
        self.participant.inputs -= {port.channel(self.component) for port in self._observed}
        self._intake = Intake(self)
        self._request_senders: dict[str, Send] = {}
        self._open_requests: list[_OpenRequest] = []
        self._busy = False  # processing a batch
        self._unfinished = False  # the batch waits for an answer or a goal, and is checked again by the timer
        self._vehicle: Any = None  # the connection to it, if any
        self._served = False  # a batch has come over this connection
        self._without_vehicle_since = time.monotonic()
        self._connection_poll = ConnectionPoll()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        wiring.participants[name] = self.participant

    def connect(self) -> None:
        """Offer services and connect clients; if the vehicle is in another process, connect to it."""
        self._request_senders = {port.channel(self.component): send for port, send in connect_clients(self, self.component).items()}
        self.serve()
        for observed in self._observed:
            self._intake.add(observed)
        if self._request_senders:
            self.create_timer(REQUEST_PERIOD, self._check_requests, clock=self._steady)
        if self.wiring.hosts_schedule:
            return
        if is_slow(self.get_name()):
            priority.lower_priority()  # steps take priority over slow work
        self.participant.set_channel_filter(lambda channel: channel not in UNTAKEN)
        self._where = address(os.environ.get("ROS_DOMAIN_ID", "0"), self.get_namespace())
        self._check_timer = self.create_timer(CHECK_PERIOD, self._finish_batch, clock=self._steady)
        self._check_timer.cancel()
        self.create_timer(CONNECT_PERIOD, self._try_connect, clock=self._steady)
        self._try_connect()

    def host_time(self) -> int:
        """Return the stamp of the newest batch, 0 before the first; a foreign clock has no effect [ns]."""
        return self.participant.now

    # -- batches from another process --------------------------------------------------------------------------------

    def _try_connect(self) -> None:
        """Try to connect to the vehicle, unless connected."""
        if self._vehicle is None:
            self._vehicle = connect_to_vehicle(self._where, self.get_name(), self.participant.inputs)
            if self._vehicle is not None:
                self._served = False
                self._connection_poll.add(self._vehicle)
                self.wiring.from_thread(self._process_batches)
            elif (waited := time.monotonic() - self._without_vehicle_since) > WARN_AFTER:
                self.component.warn(f"lockstep: no vehicle yet in namespace {self.get_namespace()} for {waited:.0f} s", WARN_REPEAT)

    def _process_batches(self) -> None:
        """Process up to `BURST` batches, then let the executor process other events first."""
        for _ in range(BURST):
            if not self._connection_poll.ready(POLL_TIMEOUT):
                break
            try:
                stamp, batch = unpack(receive(self._vehicle), topics)
            except (OSError, EOFError, PerchError):
                self._disconnect()
                return
            self._busy = self._served = True
            self.participant.begin(stamp, batch)
            self._finish_batch()
            if self._busy or self._vehicle is None:
                return
        self.wiring.from_thread(self._process_batches)

    def _finish_batch(self) -> None:
        """Send the results of a finished batch; check an unfinished one again later."""
        if not self._busy:
            return
        packets = self.participant.results()
        if packets is None:
            # The vehicle sends nothing before it has the results: it has ended. Answers come or are given up, but goals may never come.
            if self._connection_poll.ready(0.0) and all(request.answer.done() for request in self._open_requests):
                self._disconnect()
            elif not self._unfinished:
                self._unfinished = True
                self._check_timer.reset()
            return
        self._busy = False
        waited, self._unfinished = self._unfinished, False
        if waited:
            self._check_timer.cancel()
        try:
            self._vehicle.send_bytes(pack(0, packets, self.log_refusal))
        except OSError:
            self._disconnect()
            return
        if waited:
            self.wiring.from_thread(self._process_batches)

    def _results(self, results: Callable[[], list[Packet] | None]) -> list[Packet] | None:
        """Return the participant's results; an exception is logged, its packet is dropped, and the batch continues."""
        while True:
            try:
                return results()
            except Exception as error:
                self.log_refusal("step", error)

    def _disconnect(self) -> None:
        """Close the connection to a vehicle that has ended; another one may be found later."""
        self._busy = self._unfinished = False
        self._check_timer.cancel()
        self._connection_poll.remove(self._vehicle)
        self._vehicle, self._without_vehicle_since = None, time.monotonic()
        if not self._served:
            name, namespace = self.get_name(), self.get_namespace()
            self.component.warn(f"lockstep: the vehicle in namespace {namespace} closed the connection before the first step: it ended, "
                                f"or another {name} is connected, or {name} is not in its parameter participants", WARN_REPEAT)

    # -- requests ----------------------------------------------------------------------------------------------------

    def dispatch(self, port: Service | Action, work: Callable[..., None], *arguments: Any) -> None:
        """Schedule a request or a goal in front of the next batch, which may be waiting for it."""
        self.participant.enter(port.name, partial(self.guarded, port.name, work, *arguments))
        self._progress()

    def _send_request(self, channel: str, request: Any) -> Answer:
        """Send a component's request to its service; the participant delivers the answer when it is due."""
        answer = Answer()
        self._open_requests.append(_OpenRequest(channel, answer, time.monotonic()))
        self._request_senders[channel](request, partial(self._take_answer, answer))
        return answer

    def _take_answer(self, answer: Answer, value: Any) -> None:
        answer(value)
        self._progress()

    def _check_requests(self) -> None:
        """Name servers that do not answer."""
        self._open_requests = [request for request in self._open_requests if not request.answer.done()]
        for request in self._open_requests:
            channel, waited = request.channel, time.monotonic() - request.since
            if waited > WARN_AFTER and not request.overdue:
                request.overdue = f"{channel} from {server_names(self, channel)}"
                self.get_logger().warning(f"no {request.overdue} for {WARN_AFTER:g} s")
                self.repeat_diagnostics()

    def host_diagnostics(self) -> dict[str, Any]:
        """Return the overdue answers, and the servers that owe them."""
        overdue = [request.overdue for request in self._open_requests if request.overdue and not request.answer.done()]
        return {"waiting_for": ", ".join(overdue)} if overdue else {}

    def _progress(self) -> None:
        """Continue the present batch, as something for which it waits may have arrived."""
        if self.wiring.hosts_schedule:
            self.wiring.progress()
        else:
            self._finish_batch()
