"""Lockstep host: a node whose inputs are ordered by the simulator's schedule.

Component, outputs, services and actions are the same as in the arrival host. The inputs are sent by the vehicle's node: as values
within one process, otherwise as batches of serialised messages over a local socket. Outputs return the same way, and are
also published on their topics. Messages of nodes outside the lockstep are ignored, except on topics that are only recorded.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict, deque
from collections.abc import Callable
from functools import partial
from typing import Any

from perch_core.component import Action, Client, Component, Input, Service, Unavailable, ports
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.ros.asking import connect_clients
from perch_core.ros.component_node import ComponentNode
from perch_core.ros.intake import Intake
from perch_core.ros.priority import priority
from perch_core.ros.wiring import Wiring
from perch_core.values import Serialized
from perch_sim.lockstep import Answer, LocalParticipant, Packet, is_slow
from perch_sim.lockstep.link import Waiting, address, knock, pack, unpack
from rclpy.clock import Clock, ClockType

KNOCK = 0.1     # between looks for the vehicle [s]
LOOK = 0.005    # between looks whether what a batch waits for has come [s]
PATIENCE = 0.01  # with which a batch is waited for before other events are looked at [s]
ANSWERED = 65.0  # an answer that has not come for so long was lost with its server: no planner is given more than 60 s [s]
BURST = 40      # batches between which other events are looked at
OBSERVED = ("/diagnostics", "/tf", "/tf_static", "robot_description")  # taken as they come by who only keeps messages


class ParticipantNode(ComponentNode):
    """Node with one component that takes part in the lockstep."""

    def __init__(self, name: str, component: type[Component], wiring: Wiring, **kwargs: Any) -> None:
        """
        Args:
            name, component, wiring, kwargs: as in `ComponentNode`.
        """
        super().__init__(name, component, wiring, **kwargs)
        hold = self.declare_parameter("lockstep_hold", "").value
        self.declare_parameter("lockstep", True)
        self.participant = LocalParticipant(self.component, codec=topics, ask=self._ask, hold=hold, name=name)
        self.participant.begin = partial(self.guarded, "step", self.participant.begin)  # type: ignore[method-assign]
        self.participant.results = partial(self._results, self.participant.results)  # type: ignore[method-assign]
        self._observed = [port for port in ports(component, Input) if port.channel(self.component) in OBSERVED and port.value is Serialized]
        self.participant.inputs -= {port.channel(self.component) for port in self._observed}
        self._intake = Intake(self)
        self._asking: dict[str, Callable[[Any, int], None]] = {}
        self._open: defaultdict[str, deque[tuple[Answer, float]]] = defaultdict(deque)
        """Channel -> unanswered requests, each with its time on the monotonic clock [s]; a server answers them in order."""
        self._busy = False  # with a batch
        self._vehicle: Any = None  # the connection to it, where there is one
        self._waiting = Waiting()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        wiring.participants[name] = self.participant

    def connect(self) -> None:
        """Offer services and connect clients; if the vehicle is in another process, connect to it."""
        asks = {port.channel(self.component): getattr(self.component, port.name) for port in self._client_ports()}
        connect_clients(self, self.component, self._deliver_answer)
        self._asking = {port.channel(self.component): getattr(self.component, port.name) for port in self._client_ports()}
        for port in self._client_ports():  # the participant's own, which keep the time of answers
            setattr(self.component, port.name, asks[port.channel(self.component)])
        self.serve()
        for observed in self._observed:
            self._intake.add(observed)
        if self._asking:
            self.create_timer(1.0, self._give_up, clock=self._steady)
        if self.wiring.schedule_here:
            return
        if is_slow(self.get_name()):
            priority.give_way()  # a step goes before work that has time
        self._where = address(os.environ.get("ROS_DOMAIN_ID", "0"), self.get_namespace())
        self._look = self.create_timer(LOOK, self._go_on, clock=self._steady)
        self._look.cancel()
        self.create_timer(KNOCK, self._knock, clock=self._steady)
        self._knock()

    # -- batches from another process --------------------------------------------------------------------------------

    def _knock(self) -> None:
        """Try to connect to the vehicle, unless connected."""
        if self._vehicle is None:
            self._vehicle = knock(self._where, self.get_name(), self.participant.inputs)
            if self._vehicle is not None:
                self._waiting.add(self._vehicle)
                self.wiring.from_thread(self._work_on)

    def _work_on(self) -> None:
        """Process up to `BURST` batches, then let the executor process other events first."""
        for _ in range(BURST):
            if not self._waiting.ready(PATIENCE):
                break
            try:
                stamp, batch = unpack(self._vehicle.recv_bytes(), topics)
            except (OSError, EOFError, PerchError):
                self._leave()
                return
            self._busy = True
            self.participant.begin(stamp, batch)
            self._go_on()
            if self._busy or self._vehicle is None:
                return
        self.wiring.from_thread(self._work_on)

    def _go_on(self) -> None:
        """Send the results of a finished batch; check an unfinished one again later."""
        if not self._busy:
            return
        packets = self.participant.results()
        if packets is None:
            if self._look.is_canceled():
                self._look.reset()
            return
        self._busy = False
        waited = not self._look.is_canceled()
        self._look.cancel()
        try:
            self._vehicle.send_bytes(pack(0, packets))
        except OSError:
            self._leave()
            return
        if waited:
            self.wiring.from_thread(self._work_on)

    def _results(self, results: Callable[[], list[Packet] | None]) -> list[Packet] | None:
        """Return the participant's results; an exception is logged, its packet is dropped, and the batch continues."""
        while True:
            try:
                return results()
            except Exception as error:
                self.refused("step", error)

    def _leave(self) -> None:
        """Close the connection to a vehicle that has ended; another one may be found later."""
        self._busy = False
        self._waiting.remove(self._vehicle)
        self._vehicle = None

    # -- requests ----------------------------------------------------------------------------------------------------

    def bring(self, port: Service | Action, work: Callable[..., None], *arguments: Any) -> None:
        """Schedule a request or a goal in front of the next batch, which may be waiting for it."""
        self.participant.enter(port.name, partial(self.guarded, port.name, work, *arguments))
        self._progress()

    def _client_ports(self) -> list[Client]:
        return list(ports(type(self.component), Client))

    def _ask(self, channel: str, request: Any) -> Answer:
        """Send a component's request to its service; the participant delivers the answer when it is due."""
        answer = Answer()
        self._open[channel].append((answer, time.monotonic()))
        self._asking[channel](request, 0)
        return answer

    def _deliver_answer(self, port: Client, value: Any) -> None:
        waiting = self._open[port.channel(self.component)]
        if waiting:
            waiting.popleft()[0](value)
        self._progress()

    def _give_up(self) -> None:
        """Answer overdue requests with `Unavailable`: their servers may have ended, and the flight must not wait for ever."""
        for channel, waiting in tuple(self._open.items()):
            if waiting and time.monotonic() - waiting[0][1] > ANSWERED:
                self.get_logger().error(f"{channel} has not answered for {ANSWERED:g} s: its answer is given up")
                waiting.popleft()[0](Unavailable(f"{channel} has not answered within {ANSWERED:g} s"))
                self._progress()

    def _progress(self) -> None:
        """Continue the present batch, as something for which it waits may have arrived."""
        if self.wiring.schedule_here:
            self.wiring.progress()
        else:
            self._go_on()
