"""Nodes of the vehicle. In lockstep it owns the schedule, and advances when all results that are due have arrived."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from perch_core.component import Component, Input, ports
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.ros.arrival import ArrivalNode
from perch_core.ros.component_node import ComponentNode
from perch_core.ros.intake import SHARED_TOPICS
from perch_core.ros.wiring import Publication, Wiring, foreign_publishers
from perch_core.values import CameraImage
from perch_sim.lockstep import START_DEADLINE, Schedule, flight_tasks
from perch_sim.lockstep.link import ConnectionPoll, ParticipantListener, address, claimed
from perch_sim.pacing import Pacing
from perch_sim.ros.remote import RemoteParticipant
from perch_sim.timing import CONTROL_PERIOD, CONTROL_PERIOD_NS
from rclpy.clock import Clock, ClockType

CHECK_PERIOD = 0.05         # between checks of the participants [s]
FOREIGN_CHECK_PERIOD = 1.0  # between checks for foreign publishers [s]
WARN_AFTER = 3.0            # a wait is reported after so long [s] ...
WARN_REPEAT = 10.0          # ... and again at this interval [s]
POLL_TIMEOUT = 0.005        # wait for results before other events are processed [s]
BURST = 40                  # steps between which other events are processed
IMAGE_TIMEOUT = 0.02        # one wait for an image without which the flight cannot continue [s]
START_TIMEOUT = 60.0        # for participants to connect; longer if `lockstep_timeout` is [s]
START_CHECKS = 3            # consecutive checks with all participants connected before the first step


class RealTimeVehicleNode(ArrivalNode):
    """Node of `SimulatedVehicle` in real time, the only one of its ROS domain and namespace on this machine."""

    def __init__(self, name: str, component: type[Component], wiring: Wiring, **kwargs: Any) -> None:
        """
        Args:
            name, component, wiring, kwargs: as in `ArrivalNode`.

        Raises:
            PerchError: there is another one.
        """
        super().__init__(name, component, wiring, **kwargs)
        try:
            self._claim = claimed(address(os.environ.get("ROS_DOMAIN_ID", "0"), self.get_namespace()))
        except PerchError:
            super().close()
            self.destroy_node()
            raise

    def close(self) -> None:
        """As in `ComponentNode`; another vehicle may start then."""
        self._claim.close()
        super().close()


class VehicleNode(ComponentNode):
    """Node of `SimulatedVehicle` with its schedule."""

    component: Any  # a `perch_sim.lockstep.schedule.Vehicle` with `ready` and `diagnose`

    def __init__(self, name: str, component: type[Component], wiring: Wiring, **kwargs: Any) -> None:
        """
        Args:
            name, component, wiring, kwargs: as in `ComponentNode`.
        """
        super().__init__(name, component, wiring, **kwargs)
        self.declare_parameter("lockstep", True)
        self._expected = tuple(one for one in self.component.config.participants if one)
        self._listener = ParticipantListener(address(os.environ.get("ROS_DOMAIN_ID", "0"), self.get_namespace()))
        self._links = ConnectionPoll()
        self._schedule = Schedule(self.component, (), flight_tasks(self.component.scenario.latency), codec=topics)
        self._remote: dict[str, RemoteParticipant] = {}
        self._started = self._advance_queued = False
        self._failure = ""  # exception in a step, after which the schedule cannot continue
        self._complete_checks = 0
        self._created_at = self._last_progress = self._last_warning = time.monotonic()
        self._dropped: set[str] = set()
        self._disconnected: set[str] = set()  # whose connection has ended
        self._pending_images: list[tuple[Callable[[CameraImage], None], CameraImage]] = []
        self._pacing: Pacing | None = None
        self._allowance = 0
        self._counted = (time.monotonic(), 0)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        wiring.hosts_schedule, wiring.progress = True, self._advance

    def connect(self) -> None:
        """Join the participants of this process, and wait for the others."""
        for name, participant in self.wiring.participants.items():
            if name in self._expected:
                self._schedule.join(participant)
        self.create_timer(CHECK_PERIOD, self._supervise, clock=self._steady)
        self.create_timer(FOREIGN_CHECK_PERIOD, self._warn_foreign_publishers, clock=self._steady)
        self.create_timer(1.0, self._diagnose, clock=self._steady)

    def _emit_function(self, topic: str, publication: Publication):
        """Return the function that emits a value; images are emitted when they have been rendered."""
        publish_now = super()._emit_function(topic, publication)

        def publish(value: Any) -> None:
            if isinstance(value, CameraImage) and value.ready is not None:
                if self.wiring.has_reader(topic) or publication.has_subscribers():
                    self._pending_images.append((publish_now, value))
            else:
                publish_now(value)

        return publish

    # -- participants ------------------------------------------------------------------------------------------------

    def _accept_participants(self) -> None:
        """Accept participants that connect. A name has one connection: while it lasts, further ones are refused."""
        for name, inputs, connection in self._listener.accept():
            if name not in self._expected:
                self.warn_once(f"lockstep: {name!r} tried to connect but is not in the parameter participants: ignored")
                connection.close()
                continue
            former = self._remote.get(name)
            if name in self.wiring.participants or former is not None and name not in self._disconnected:
                self.warn_once(f"lockstep: another {name!r} tried to connect: ignored; end the process that is connected first")
                connection.close()
                continue
            if former is not None:
                former.close()
            one = self._remote[name] = RemoteParticipant(name, inputs, connection, self.log_refusal)
            self._links.add(connection)
            self._dropped.discard(name)
            self._disconnected.discard(name)
            if self._started:
                self._schedule.join(one)
                self.get_logger().warning(f"lockstep: {name} has reconnected")

    def _receive(self, timeout: float) -> bool:
        """Receive results that arrive within a time [s]; return whether there were any."""
        for one in self._remote.values():
            one.flush()
        connections = self._links.ready(timeout)
        for connection in connections:
            one = next(remote for remote in self._remote.values() if remote.connection is connection)
            one.receive()
            if one.ended:
                self._links.remove(connection)
                self.get_logger().error(f"lockstep: {one.name} {one.ended}")
                if self._started:
                    self._disconnected.add(one.name)
                else:  # it is missing again
                    del self._remote[one.name]
                    one.close()
        return bool(connections)

    def _missing(self) -> list[str]:
        """Return the expected participants that have not connected yet."""
        here = set(self._schedule.names) | set(self._remote) | self._dropped
        return [name for name in self._expected if name not in here]

    # -- stepping ----------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Advance the flight as far as the participants permit."""
        if self._started and not self._advance_queued and not self._failure:
            self.wiring.enter(self.guarded, "advance", self._burst)

    def _burst(self) -> None:
        """Advance up to `BURST` steps, then let the executor process other events first."""
        schedule, received = self._schedule, False
        for _ in range(BURST):
            if not self._step_due():
                return
            if self._remote and not received:
                self._receive(0.0)
            received = False
            try:
                completed = schedule.advance()
            except Exception as error:
                self._failure = f"{type(error).__name__}: {error}"
                raise RuntimeError("the simulation has failed in a step and does not continue") from error
            if completed:
                self._last_progress = time.monotonic()
                if self._pending_images:
                    self._publish_rendered()
            elif not schedule.await_image(IMAGE_TIMEOUT):
                if not any(pending.name in self._remote for pending in schedule.pending()):
                    return  # a participant of this process waits for an answer or a goal; `wiring.progress` continues
                received = self._receive(POLL_TIMEOUT)
                if not received:
                    break
        if not self._advance_queued:
            self._advance_queued = True
            self.wiring.from_thread(self._advance_again)

    def _advance_again(self) -> None:
        self._advance_queued = False
        self.guarded("advance", self._burst)

    def _step_due(self) -> bool:
        """Return whether the next step is due: a flight without controller is paced by the wall clock."""
        if "controller" in self._schedule.names:
            self._pacing = None
            return True
        if self._pacing is None:
            self._pacing = Pacing(CONTROL_PERIOD_NS, time.monotonic_ns())
        if self._allowance == 0:
            self._allowance = self._pacing.due(time.monotonic_ns())
            if self._allowance == 0:
                return False
        self._allowance -= 1
        return True

    def _publish_rendered(self) -> None:
        pending = []
        for publish, image in self._pending_images:
            if image.ready is not None and not image.ready(0.0):
                pending.append((publish, image))
            elif image.pixels() is not None:
                publish(image)
        self._pending_images = pending

    # -- supervision -------------------------------------------------------------------------------------------------

    def _supervise(self) -> None:
        """Start the flight when all participants have connected; report and drop silent participants."""
        now = time.monotonic()
        self._accept_participants()
        if not self._started:
            self._receive(0.0)  # participants that end before the start
            self._check_start(now)
        elif not self._failure:
            self._check_silence(now)
        self._advance()

    def _describe_wait(self) -> str:
        """Describe what the flight waits for: participants, and the missing input of each."""
        if self._failure:
            return f"a new start, as the simulation has failed: {self._failure}"
        if not self._started:
            missing = self._missing()
            if missing:
                return f"{', '.join(missing)} to connect"
            return "the first images to be rendered"
        return "; ".join(f"{pending.name}: {pending.what} (since {pending.since * 1e-9:.3f} s)" for pending in self._schedule.pending())

    def _check_start(self, now: float) -> None:
        missing = self._missing()
        complete = not missing and self.component.ready()
        self._complete_checks = self._complete_checks + 1 if complete else 0
        if self._complete_checks >= START_CHECKS:
            for one in self._remote.values():
                self._schedule.join(one)
            self._started, self._last_progress = True, now
            self.get_logger().info(f"lockstep: starting with {', '.join(self._schedule.names) or 'no participants'}")
            return
        if not complete:
            self._warn_of_wait(now, self._created_at)
        if missing and now - self._created_at > (timeout := max(START_TIMEOUT, self.component.config.lockstep_timeout)):
            for name in missing:
                self._dropped.add(name)
                self.get_logger().error(f"lockstep: {name} has not connected within {timeout:g} s: dropped")

    def _check_silence(self, now: float) -> None:
        silence = now - self._last_progress
        if silence < WARN_AFTER:
            return
        pending = self._schedule.pending()
        if pending:
            self._warn_of_wait(now, self._last_progress)
        for name in [one.name for one in pending if one.name in self._remote]:
            if name not in self._disconnected and self._schedule.now < START_DEADLINE:
                continue  # it may wait for a goal, and its planners may still compile
            if silence > self.component.config.lockstep_timeout:  # a node that has ended may be restarted meanwhile
                self._drop(name, "disconnected" if name in self._disconnected else f"silent for {silence:.0f} s")
                self._last_progress = now

    def _warn_of_wait(self, now: float, since: float) -> None:
        """Log what the flight has waited for since a time [s], after `WARN_AFTER` and at intervals of `WARN_REPEAT`."""
        if now - since >= WARN_AFTER and (self._last_warning <= since or now - self._last_warning > WARN_REPEAT):
            self._last_warning = now
            self.get_logger().warning(f"lockstep: for {now - since:.0f} s waiting for {self._describe_wait()}")

    def _drop(self, name: str, why: str) -> None:
        self.get_logger().error(f"lockstep: {name} is {why}: dropped, the flight continues without it")
        self._dropped.add(name)
        self._schedule.drop(name)
        one = self._remote.pop(name)  # if it continues, it finds its connection closed and reconnects
        self._links.remove(one.connection)
        one.close()

    def _warn_foreign_publishers(self) -> None:
        """Warn of nodes that publish on topics of the flight without taking part; their messages are ignored."""
        inputs = set().union(*(one.inputs for one in (*self._remote.values(), *self.wiring.participants.values())))
        inputs = (inputs - set(SHARED_TOPICS)) | {port.channel(self.component) for port in ports(type(self.component), Input)}
        members = {f"{self.get_namespace().rstrip('/')}/{name}" for name in (*self._expected, self.get_name())}
        for channel in sorted(inputs):
            for publisher in foreign_publishers(self, self.resolve_topic_name(channel), members):
                self.warn_once(f"{channel}: {publisher} publishes it but is not a participant of the lockstep: ignored")

    def close(self) -> None:
        """Stop accepting participants, and release the node's resources."""
        self._listener.close()
        super().close()

    # -- diagnostics -------------------------------------------------------------------------------------------------

    def host_diagnostics(self) -> dict[str, Any]:
        """Return the speed of simulation time, and what the flight waits for."""
        now, steps = time.monotonic(), self._schedule.index
        since, before = self._counted
        self._counted = (now, steps)
        rate = (steps - before) / max(now - since, 1e-9)
        return {"steps_per_s": rate, "real_time_factor": rate * CONTROL_PERIOD, "waiting_for": self._describe_wait()}

    def _diagnose(self) -> None:
        """Emit diagnostics; called each second of wall-clock time, as simulation time may stand still."""
        self.component.diagnose()
