"""Node of the vehicle in lockstep: owns the schedule, and advances when all results that are due have arrived."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from perch_core.component import Component
from perch_core.ros import topics
from perch_core.ros.component_node import ComponentNode
from perch_core.ros.intake import SHARED
from perch_core.ros.wiring import Publication, Wiring, foreign_writers
from perch_core.values import CameraImage
from perch_sim.lockstep import BEGUN, Schedule, flight_tasks
from perch_sim.lockstep.link import Door, Waiting, address
from perch_sim.pacing import Pacing
from perch_sim.ros.remote import RemoteParticipant
from perch_sim.timing import CONTROL_PERIOD, CONTROL_PERIOD_NS
from rclpy.clock import Clock, ClockType

LOOK = 0.05         # between looks at who is silent [s]
STRANGERS = 1.0     # between looks for writers that do not count [s]
NAMED = 3.0         # a wait is named after so long [s] ...
NAG = 10.0          # ... and again this often [s]
PATIENCE = 0.005    # with which results are waited for before other events are looked at [s]
BURST = 40          # steps between which other events are looked at
DRAWING_WAIT = 0.02  # for an image without which nobody can go on, at a time [s]
START_PATIENCE = 60.0  # for participants to come, where a silent one is not given more [s]
SETTLED_LOOKS = 3   # everybody has to be there this often in a row before the first step


class VehicleNode(ComponentNode):
    """Node of `SimulatedVehicle` with its schedule."""

    component: Any  # a `perch_sim.lockstep.schedule.Vehicle` that says whether it is ready, and diagnoses itself

    def __init__(self, name: str, component: type[Component], wiring: Wiring, **kwargs: Any) -> None:
        """
        Args:
            name, component, wiring, kwargs: as in `ComponentNode`.
        """
        super().__init__(name, component, wiring, **kwargs)
        self.declare_parameter("lockstep", True)
        self._expected = tuple(one for one in self.component.config.participants if one)
        self._door = Door(address(os.environ.get("ROS_DOMAIN_ID", "0"), self.get_namespace()))
        self._links = Waiting()
        self._schedule = Schedule(self.component, (), flight_tasks(self.component.scenario.latency), codec=topics)
        self._remote: dict[str, RemoteParticipant] = {}
        self._started = self._again = False
        self._looks = 0
        self._begun = self._progress = self._named = time.monotonic()
        self._dropped: set[str] = set()
        self._gone: set[str] = set()  # whose connection has ended
        self._undrawn: list[tuple[Callable[[CameraImage], None], CameraImage]] = []
        self._pacing: Pacing | None = None
        self._allowance = 0
        self._counted = (time.monotonic(), 0)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        wiring.schedule_here, wiring.progress = True, self._advance

    def connect(self) -> None:
        """Join the participants of this process, and wait for the others."""
        for name, participant in self.wiring.participants.items():
            if name in self._expected:
                self._schedule.join(participant)
        self.create_timer(LOOK, self._look_after, clock=self._steady)
        self.create_timer(STRANGERS, self._look_for_strangers, clock=self._steady)
        self.create_timer(1.0, self._diagnose, clock=self._steady)

    def _emitted(self, topic: str, publication: Publication):
        """Return the function that emits a value; images are emitted when they have been rendered."""
        usual = super()._emitted(topic, publication)

        def publish(value: Any) -> None:
            if isinstance(value, CameraImage) and value.ready is not None:
                if self.wiring.read_here(topic) or publication.heard():
                    self._undrawn.append((usual, value))
            else:
                usual(value)

        return publish

    # -- participants ------------------------------------------------------------------------------------------------

    def _let_in(self) -> None:
        """Accept participants that connect; one that reconnects replaces its former connection."""
        for name, inputs, connection in self._door.let_in():
            if name not in self._expected:
                self.warn_once(f"lockstep: {name!r} wants to take part but is not in the parameter participants: it is ignored")
                connection.close()
                continue
            known = self._remote.get(name)
            if known is not None:
                self._links.remove(known.connection)
                known.close()
            one = self._remote[name] = RemoteParticipant(name, inputs, connection)
            self._links.add(connection)
            self._dropped.discard(name)
            self._gone.discard(name)
            if self._started:
                self._schedule.join(one)
                self.get_logger().warning(f"lockstep: {name} is back")

    def _receive(self, timeout: float) -> bool:
        """Receive results that arrive within a time [s]; return whether there were any."""
        for one in self._remote.values():
            one.go_on()
        connections = self._links.ready(timeout)
        for connection in connections:
            one = next(remote for remote in self._remote.values() if remote.connection is connection)
            one.receive()
            if one.gone:
                self._links.remove(connection)
                self._gone.add(one.name)
                self.get_logger().error(f"lockstep: {one.name} is gone")
        return bool(connections)

    def _missing(self) -> list[str]:
        """Return the expected participants that have not connected yet."""
        here = set(self._schedule.names) | set(self._remote) | self._dropped
        return [name for name in self._expected if name not in here]

    # -- going on ----------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Advance the flight as far as the participants permit."""
        if self._started and not self._again:
            self.wiring.enter(self.guarded, "advance", self._burst)

    def _burst(self) -> None:
        """Advance up to `BURST` steps, then let the executor process other events first."""
        schedule = self._schedule
        for _ in range(BURST):
            if not self._in_time():
                return
            if self._remote:
                self._receive(0.0)
            if schedule.advance():
                self._progress = time.monotonic()
                if self._undrawn:
                    self._publish_drawn()
            elif not schedule.await_image(DRAWING_WAIT):
                if not any(owed.name in self._remote for owed in schedule.owed()):
                    return  # a neighbour waits for an answer or a goal, and says so when it has come
                if not self._receive(PATIENCE):
                    break
        if not self._again:
            self._again = True
            self.wiring.from_thread(self._advance_again)

    def _advance_again(self) -> None:
        self._again = False
        self.guarded("advance", self._burst)

    def _in_time(self) -> bool:
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

    def _publish_drawn(self) -> None:
        waiting = []
        for publish, image in self._undrawn:
            if image.ready is not None and not image.ready(0.0):
                waiting.append((publish, image))
            elif image.pixels() is not None:
                publish(image)
        self._undrawn = waiting

    # -- the silent --------------------------------------------------------------------------------------------------

    def _look_after(self) -> None:
        """Start the flight when all participants have connected; report and drop silent participants."""
        now = time.monotonic()
        self._let_in()
        if not self._started:
            self._receive(0.0)  # who ends before the start
            self._look_for_all(now)
        else:
            self._look_for_silent(now)
        self._advance()

    def _waiting(self) -> str:
        """Describe what the flight waits for: participants, and what each owes."""
        if not self._started:
            missing = self._missing()
            if missing:
                return f"{', '.join(missing)} to come"
            return "the first images to be drawn"
        return "; ".join(f"{owed.name}: {owed.what} (since {owed.since * 1e-9:.3f} s)" for owed in self._schedule.owed())

    def _look_for_all(self, now: float) -> None:
        missing = self._missing()
        complete = not missing and self.component.ready()
        self._looks = self._looks + 1 if complete else 0
        if self._looks >= SETTLED_LOOKS:
            for one in self._remote.values():
                self._schedule.join(one)
            self._started, self._progress = True, now
            self.get_logger().info(f"lockstep: starting with {', '.join(self._schedule.names) or 'no participants'}")
        elif missing and now - self._begun > (patience := max(START_PATIENCE, self.component.config.lockstep_timeout)):
            for name in missing:
                self._dropped.add(name)
                self.get_logger().error(f"lockstep: {name} has not come within {patience:g} s: dropped")

    def _look_for_silent(self, now: float) -> None:
        silence = now - self._progress
        if silence < NAMED:
            return
        owed = self._schedule.owed()
        if owed and (self._named < self._progress or now - self._named > NAG):
            self._named = now
            self.get_logger().warning(f"lockstep: for {silence:.0f} s waiting for {self._waiting()}")
        for name in [one.name for one in owed if one.name in self._remote]:
            if name not in self._gone and self._schedule.now < BEGUN:
                continue  # it may wait for a goal, and planners that are to serve it may still compile
            if silence > self.component.config.lockstep_timeout:  # one that has ended may be started again meanwhile
                self._drop(name, "gone" if name in self._gone else f"silent for {silence:.0f} s")
                self._progress = now

    def _drop(self, name: str, why: str) -> None:
        self.get_logger().error(f"lockstep: {name} is {why}: dropped, the flight goes on without it")
        self._dropped.add(name)
        self._schedule.drop(name)
        one = self._remote.pop(name)  # once it goes on, it finds its connection closed and comes again
        self._links.remove(one.connection)
        one.close()

    def _look_for_strangers(self) -> None:
        """Warn of nodes that publish on topics of the flight without taking part; their messages are ignored."""
        inputs = set().union(*(one.inputs for one in (*self._remote.values(), *self.wiring.participants.values())))
        inputs = (inputs - set(SHARED)) | {"motor_command"}
        known = {f"{self.get_namespace().rstrip('/')}/{name}" for name in (*self._expected, self.get_name())}
        for channel in sorted(inputs):
            for stranger in foreign_writers(self, self.resolve_topic_name(channel), known):
                self.warn_once(f"{channel}: {stranger} publishes it but takes no part in the lockstep: it is ignored")

    def close(self) -> None:
        """Stop accepting participants, and release the node's resources."""
        self._door.close()
        super().close()

    # -- people ------------------------------------------------------------------------------------------------------

    def host_figures(self) -> dict[str, Any]:
        """Return the speed of simulation time, and what the flight waits for."""
        now, steps = time.monotonic(), self._schedule.index
        since, before = self._counted
        self._counted = (now, steps)
        rate = (steps - before) / max(now - since, 1e-9)
        return {"steps_per_s": rate, "real_time_factor": rate * CONTROL_PERIOD, "waiting_for": self._waiting()}

    def _diagnose(self) -> None:
        """Emit diagnostics; called each second of wall-clock time, as simulation time may stand still."""
        self.component.diagnose()
