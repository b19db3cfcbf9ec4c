"""One flight on the real graph with one fault. The struck node has its own process; no cameras; a pilot sends the goal."""

from __future__ import annotations

import gc
import re
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_eval.domain import own_domain
from perch_eval.fork_server import alive
from perch_eval.graph_faults.cases import LOCKSTEP, NAMED, PROCESS, SAFE, Case, Situation, ending, named
from perch_eval.graph_faults.group import Group
from perch_eval.graph_faults.ros.watcher import Watcher
from perch_eval.modelled_sight_node import blind_launches
from perch_eval.ros.mission_client import MissionClient
from perch_sim import seeding
from perch_sim.contact_event import ContactState
from perch_sim.obstacles import pad_surface
from perch_sim.scenario import load_scenario

SCENARIO = """
extends: surface_90
name: surface_90_blind
nodes: [vehicle, vio_model, estimator, target_localizer, perching_planner, controller, mission]
parameters: {perching_planner: {time_limit: 20.0}, mission: {mission.plan_lead: 1.5}, vehicle: {lockstep_timeout: 8.0}}
"""
"""Scenario of the flights, without images. Plans begin 1.5 s after their request instead of 0.1 s, for a busy machine; the
lockstep drops a node that hangs after 8 s instead of 60 s."""
DOMAINS = range(43, 70)
READY = 60.0     # for the nodes to come up [s]
STALL = 30.0     # simulation time may stand still for so long [s]
SETTLE = 4.0     # an end that lasts so long is one, in simulation time [s]
LIMIT = 60.0     # after the fault a flight is judged as it is, wall clock [s]
UNANSWERED = "unanswered"
NEAR = 0.15      # of the centre of mass from the pad: the contact begins [m]


@dataclass(frozen=True)
class Row:
    """Result of one flight.

    Attributes:
        fault, node, phase, mode, seed: the case.
        commit: commit of the code.
        struck: simulation time of the fault [s]; None: the flight ended before.
        before: height [m], speed [m/s] and tilt [deg] at the fault.
        end: hovering, landed, perched or motors off; any other end is not safe.
        named: wall-clock time from the fault to its first report [s]; None: it was not reported.
        words: source and text of that report.
        goal: the mission's result, or the pilot's error message.
        impact: largest normal speed of a contact with the floor or a wall after the fault [m/s].
        ended: other nodes that ended by themselves.
        left: processes, sockets and shared memory that remained after all nodes were stopped.
        duration: wall-clock time of the flight [s].
    """

    fault: str
    node: str
    phase: str
    mode: str
    seed: int
    commit: str
    struck: float | None
    before: tuple[float, float, float]
    end: str
    named: float | None
    words: str
    goal: str
    impact: float
    ended: tuple[str, ...]
    left: tuple[str, ...]
    duration: float


class _Director:
    """Applies the fault at its time.

    Attributes:
        said: (seconds since the epoch, text) received by the pilot.
        struck: time of the fault, seconds since the epoch; None: not yet.
        at: the same in simulation time [s].
        before: situation at the fault.
    """

    def __init__(self, case: Case, group: Group, watcher: Watcher, takeoff_height: float, pad: Any) -> None:
        self._case, self._group, self._watcher = case, group, watcher
        self._share = float(seeding.stream(case.seed, "moment").uniform(0.2, 0.9))
        self._height, self._pad = takeoff_height, pad
        self._phase, self._since, self._duration = "", 0.0, 0.0
        self.said: list[tuple[float, str]] = []
        self.struck: float | None = None
        self.at: float | None = None
        self.before = Situation(0.0, 0.0, 0.0, 0.0, False, False)

    def on_phase(self, t: float, phase: str, message: str) -> None:
        """Receive feedback of the goal: keep every message, and the start and duration of the mission's phases."""
        self.said.append((time.time(), message))
        if phase != self._phase and phase not in ("waiting", "cancelling"):
            self._phase, self._since = phase, self._watcher.time
            planned = re.match(r"perching, ([\d.]+) s", message)
            self._duration = float(planned[1]) if planned else self._duration

    def look(self) -> None:
        """Apply the fault if its time has come."""
        if self.struck is not None or not self._now():
            return
        case, group = self._case, self._group
        self.before = self._watcher.situation() or self.before
        self.at, self.struck = self._watcher.time, time.time()
        if case.fault not in PROCESS:
            self._watcher.disturb(case.fault)
        elif case.fault == "stop":
            group.signal(case.node, signal.SIGSTOP)
        else:
            group.signal(case.node, signal.SIGKILL)
            if case.fault == "restart":
                while alive(group.pids[case.node]):
                    time.sleep(0.001)
                group.start(case.node)

    def follow(self) -> None:
        """Like `look`, while the pilot waits for the goal's end.

        Raises:
            PerchError: the mission was killed or stopped, and the time to report that is over; the goal will not be answered.
        """
        self.look()
        if self._case.node == "mission" and self._case.fault in ("kill", "stop") and self.struck is not None and self.told:
            raise PerchError(UNANSWERED)

    @property
    def told(self) -> bool:
        """Whether the time to report the fault is over, or there was no fault yet."""
        return self.struck is None or time.time() - self.struck > NAMED + 0.5

    def _now(self) -> bool:
        phase, elapsed, watcher = self._phase, self._watcher.time - self._since, self._watcher
        if self._case.phase == "climb":
            return phase == "take_off" and watcher.height > self._share * self._height
        if self._case.phase == "search":
            return phase == "searching" and elapsed > 0.5 * self._share
        if self._case.phase == "approach":
            return phase == "tracking" and elapsed > self._share * (self._duration - 0.2)
        if self._case.phase == "contact":
            return phase in ("tracking", "verifying") and (self._pad.normal @ (watcher.position - self._pad.p_WS)) < NEAR
        return phase == "perched" and elapsed > 0.5 * self._share


def fly(case: Case, folder: Path, commit: str) -> Row:
    """Fly one case.

    Args:
        case: case to be flown.
        folder: receives scenario, parameters and logs.
        commit: commit of the code, for the row.

    Raises:
        PerchError: the nodes did not start.
    """
    began = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    source = folder / "flown.yaml"
    source.write_text(SCENARIO)
    scenario, lockstep = load_scenario(source), case.mode == LOCKSTEP
    hold = {"mission": {"lockstep_hold": "perch"}} if lockstep else None
    launches = blind_launches(scenario, case.seed, str(source), lockstep, overrides=hold)
    with own_domain(sorted(DOMAINS, key=lambda d: (d - case.seed) % len(DOMAINS))) as domain:
        group, pilot = Group(launches, case, folder, domain), MissionClient()
        try:
            watcher = Watcher(pilot)
            director = _Director(case, group, watcher, scenario.mission.takeoff_height, pad_surface(scenario, 0.0))
            group.start_all()
            limit = time.monotonic() + READY
            while missing := group.nodes - pilot.visible_nodes():
                if time.monotonic() > limit or group.ended():
                    raise PerchError(f"not ready: {', '.join(group.ended() or sorted(missing))}; logs: {folder}")
            try:
                result = pilot.fly(scenario, director.on_phase, director.follow, stall=STALL)
                goal = f"{result.outcome}: {result.message}"
            except PerchError as error:
                goal = str(error)
            if goal != UNANSWERED:
                director.said.append((time.time(), goal))
            end = _settled(pilot, watcher, director)
            ended = tuple(name for name in group.ended() if name != case.node or case.fault == "restart" or case.fault not in PROCESS)
        finally:
            group.stop()
            pilot.close()
            gc.collect()  # a goal is a cycle that holds the pilot's DDS participant
            left = group.left()
    found = named(case, director.struck, group.lines(), director.said) if director.struck is not None else None
    touched = [c.normal_speed for c in watcher.contacts if c.state in (ContactState.COLLISION, ContactState.GROUND)
               and director.at is not None and 1e-9 * c.stamp >= director.at]
    after, words = (None, "") if found is None else (round(found[0], 2), found[1][:300])
    return Row(*case, case.seed, commit, director.at, director.before[:3], end, after, words, goal[:300],
               round(max(touched, default=0.0), 2), ended, left, round(time.monotonic() - began, 1))


def _settled(pilot: MissionClient, watcher: Watcher, director: _Director) -> str:
    """Wait until an end lasts and the time to report the fault is over; return the end."""
    limit, since, last = time.monotonic() + LIMIT, watcher.time, ""
    while time.monotonic() < limit:
        pilot.spin(0.05)
        director.look()
        director.said += [(time.time(), words) for words in pilot.news()]
        now = watcher.situation()
        if now is None:
            continue
        found = ending(now)
        if found != last:
            last, since = found, watcher.time
        if found in SAFE and watcher.time - since > SETTLE and director.told:
            return found
    return f"{last}, which does not last" if last in SAFE else last
