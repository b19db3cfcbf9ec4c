"""A stack whose programs can be killed, stopped and started again while a goal is flown."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from subprocess import TimeoutExpired

from nav_msgs.msg import Odometry
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_eval import modelled_sight_node
from perch_eval.modelled_sight_node import imageless_launches
from perch_eval.nodes import ALL_NODES, node_programs
from perch_eval.ros.mission_client import FlightResult, MissionClient
from perch_msgs.msg import ControllerStatus
from perch_sim.scenario import Scenario, load_scenario
from system.forks import NODES, Piped
from system.scripts import PATIENCE

SHORT = """
extends: surface_90
name: short
nodes: [vehicle, vio_model, estimator, target_localizer, perching_planner, controller, mission]
parameters: {vehicle: {lockstep_timeout: 300.0}}
"""
"""A perch without images: VIO and sightings are made from the truth. On a busy machine nodes may take their time to start."""
BLIND = SHORT.replace("target_localizer, ", "")
"""The same with nobody to see: it climbs, looks for a target and finds none."""


class Running:
    """A program of nodes, forked from a process that has their code; what an executable is by itself is shown in `test_stopping.py`."""

    def __init__(self, command: Sequence[str], hear: Callable[[str], None]) -> None:
        """
        Args:
            command: a Python script and its arguments.
            hear: receives each line that it writes, from a thread of its own.
        """
        self._process = Piped(NODES, command)
        self._reader = threading.Thread(target=self._read, args=(hear,), daemon=True)
        self._reader.start()

    def _read(self, hear: Callable[[str], None]) -> None:
        with self._process.stdout as lines:
            for line in lines:
                hear(line.rstrip())

    def signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def end(self, patience: float) -> None:
        """Wait for its end; kill it where that does not come in time [s]."""
        try:
            self._process.wait(patience)
        except TimeoutExpired:
            self.signal(signal.SIGKILL)
            self._process.wait(PATIENCE)
        self._reader.join(PATIENCE)


class Rig:
    """Programs, the lines that they write, and a pilot.

    Attributes:
        pilot: sends goals; time is that of `/clock`.
        truth: the vehicle's newest true state.
        controller: newest state of the controller, as in `perch_msgs/ControllerStatus`.
    """

    def __init__(self, folder: Path, alone: Collection[str], lockstep: bool, scenario: str) -> None:
        """
        Args:
            folder: receives scenario, parameters and logs.
            alone: nodes with a process each; the others share one.
            lockstep: simulation time waits; otherwise the wall clock paces it.
            scenario: what is flown, in YAML.
        """
        source = folder / "short.yaml"
        source.write_text(scenario)
        self.scenario = load_scenario(source)
        self._lines, self._came = [], threading.Lock()
        launches = imageless_launches(self.scenario, 1, str(source), lockstep, overrides={"mission": {"lockstep_hold": "perch"}} if lockstep else {})
        together = [name for name in ALL_NODES if name not in (*alone, *modelled_sight_node.NODES)]
        started = node_programs(launches, folder, composed=together)
        self._programs = {program.name: program for program in started}
        self._running: dict[str, Running] = {}
        self.pilot = MissionClient()
        self.truth, self.controller, self._cues = None, -1, []
        node = self.pilot.node
        node.create_subscription(Odometry, "ground_truth/odometry", self._see, topics.topic("odometry").qos.subscribe)
        node.create_subscription(ControllerStatus, "controller/status", self._hear, topics.topic("controller/status").qos.subscribe)

    def _see(self, message: Odometry) -> None:
        self.truth = message

    def _hear(self, message: ControllerStatus) -> None:
        self.controller = message.state

    def start(self, name: str) -> None:
        """Start a program, for the first time or again."""
        arguments = self._programs[name].command
        if name in modelled_sight_node.NODES:
            arguments = (modelled_sight_node.__file__, name, *arguments[1:])
        self._running[name] = Running(arguments, lambda line: self._write(name, line))

    def start_all(self) -> None:
        """Start all programs, and wait until their nodes are in the graph."""
        for name in self._programs:
            self.start(name)
        wanted = {node for program in self._programs.values() for node in program.nodes}
        self.until(lambda: wanted <= self.pilot.visible_nodes(), "the nodes do not come up")

    def _write(self, name: str, line: str) -> None:
        with self._came:
            self._lines.append(f"{name}: {line}")

    def said(self, words: str) -> int:
        """How many lines match."""
        with self._came:
            return sum(re.search(words, line) is not None for line in self._lines)

    def kill(self, name: str) -> None:
        """Kill a program, and wait for its end."""
        self._running[name].signal(signal.SIGKILL)
        self._running[name].end(PATIENCE)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a program."""
        self._running[name].signal(number)

    def until(self, done: Callable[[], bool], problem: str) -> None:
        """Run the pilot's callbacks until `done`."""
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end, f"{problem}\n" + "\n".join(self._lines[-30:])
            self.pilot.spin(0.02)

    def listen(self, duration: float) -> None:
        """Run the pilot's callbacks for some wall-clock time [s]."""
        end = time.monotonic() + duration
        self.until(lambda: time.monotonic() > end, "")

    def fly(self, acts: Iterator[Callable[[], bool] | str], scenario: Scenario | None = None) -> FlightResult | PerchError:
        """Fly a goal, and meanwhile go through `acts`: it yields what it waits for, a condition, or a phase or the goal's end.

        Args:
            acts: done while it flies.
            scenario: whose goal is flown; None: the rig's.
        """
        state: dict[str, object] = {"waits": None, "over": False}
        phases = [""]  # the present one, and those that were told since the last act

        def hear(_: float, phase: str, __: str) -> None:
            if phase != "waiting":  # which is the pilot's own word
                phases.append(phase)

        def go_on() -> None:
            while not state["over"]:
                waits = state["waits"]
                if waits is not None and not (waits in phases if isinstance(waits, str) else waits()):
                    return
                del phases[:-1]
                try:
                    state["waits"] = next(acts)
                except StopIteration:
                    state["over"] = True

        try:
            result: FlightResult | PerchError = self.pilot.fly(scenario or self.scenario, hear, go_on, PATIENCE)
        except PerchError as error:
            result = error
        end = time.monotonic() + PATIENCE
        while not state["over"]:  # what is still to be done after the goal's end
            assert time.monotonic() < end, f"what was to be done does not end, after {result}\n" + "\n".join(self._lines[-30:])
            if isinstance(state["waits"], str):
                state["waits"] = None
            go_on()
            self.pilot.spin(0.02)
        return result

    def at_rest(self) -> bool:
        """Whether the vehicle hardly moves."""
        v = self.truth.twist.twist.linear
        return max(map(abs, (v.x, v.y, v.z))) < 0.3

    def on_floor(self) -> bool:
        """Whether it stands or lies on the floor."""
        return self.truth.pose.pose.position.z < 0.25 and self.at_rest()

    def stop(self) -> None:
        """End everything."""
        for running in self._running.values():
            running.signal(signal.SIGCONT)
            running.signal(signal.SIGINT)
        for running in self._running.values():
            running.end(10.0)
        self.pilot.close()


@contextmanager
def rig(folder: Path, alone: Collection[str], lockstep: bool = True, scenario: str = SHORT) -> Iterator[Rig]:
    """A rig that is up, in the domain of `ROS_DOMAIN_ID`."""
    one = Rig(folder, alone, lockstep, scenario)
    try:
        one.start_all()
        yield one
    finally:
        one.stop()
