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
from perch_eval.domain import domain_in_environment
from perch_eval.ending import SAFE, Situation, ending
from perch_eval.fork_server import alive
from perch_eval.graph_faults.cases import LOCKSTEP, PROCESS, REPORT_LIMIT, Case, first_report, judged_end
from perch_eval.graph_faults.group import Group
from perch_eval.graph_faults.ros.watcher import Watcher
from perch_eval.modelled_sight_node import imageless_launches
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
READY_TIMEOUT = 60.0  # for the nodes to come up [s]
STALL_TIMEOUT = 30.0  # simulation time may stand still for so long [s]
SETTLING_TIME = 4.0   # an end that lasts so long is one, in simulation time [s]
TIME_LIMIT = 60.0     # after the fault a flight is judged as it is, wall clock [s]
UNANSWERED = "unanswered"
CONTACT_DISTANCE = 0.15  # of the centre of mass from the pad where the contact begins [m]


@dataclass(frozen=True)
class Row:
    """Result of one flight.

    Attributes:
        fault, node, phase, mode, seed: the case.
        commit: commit of the code.
        struck: simulation time of the fault [s]; None: the flight ended before.
        before: height [m], speed [m/s] and tilt [deg] at the fault.
        end: hovering, landed, perched or motors off; any other end is not safe, such as crashed.
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


class _FaultInjector:
    """Applies the fault when its time has come.

    Attributes:
        received: (seconds since the epoch, text) received by the pilot.
        injection_wall_time: time of the fault, seconds since the epoch; None: not yet.
        injection_time: the same in simulation time [s].
        before: situation at the fault.
    """

    def __init__(self, case: Case, group: Group, watcher: Watcher, takeoff_height: float, pad: Any) -> None:
        self._case, self._group, self._watcher = case, group, watcher
        self._share = float(seeding.stream(case.seed, "moment").uniform(0.2, 0.9))
        self._height, self._pad = takeoff_height, pad
        self._phase, self._since, self._duration = "", 0.0, 0.0
        self.received: list[tuple[float, str]] = []
        self.injection_wall_time: float | None = None
        self.injection_time: float | None = None
        self.before = Situation(0.0, 0.0, 0.0, 0.0, False, False)

    def on_phase(self, t: float, phase: str, message: str) -> None:
        """Receive feedback of the goal: keep every message, and the start and duration of the mission's phases."""
        self.received.append((time.time(), message))
        if phase != self._phase and phase not in ("waiting", "cancelling"):
            self._phase, self._since = phase, self._watcher.time
            planned = re.match(r"perching, ([\d.]+) s", message)
            self._duration = float(planned[1]) if planned else self._duration

    def apply_if_due(self) -> None:
        """Apply the fault if its time has come."""
        if self.injection_wall_time is not None or not self._is_due():
            return
        case, group = self._case, self._group
        self.before = self._watcher.situation() or self.before
        self.injection_time, self.injection_wall_time = self._watcher.time, time.time()
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

    def check_goal(self) -> None:
        """Like `apply_if_due`, while the pilot waits for the goal's end.

        Raises:
            PerchError: the mission was killed or stopped, and the time to report that is over; the goal will not be answered.
        """
        self.apply_if_due()
        mission_lost = self._case.node == "mission" and self._case.fault in ("kill", "stop")
        if mission_lost and self.injection_wall_time is not None and self.report_time_over:
            raise PerchError(UNANSWERED)

    @property
    def report_time_over(self) -> bool:
        """Whether the time to report the fault is over, or there was no fault yet."""
        return self.injection_wall_time is None or time.time() - self.injection_wall_time > REPORT_LIMIT + 0.5

    def _is_due(self) -> bool:
        phase, elapsed, watcher = self._phase, self._watcher.time - self._since, self._watcher
        if self._case.phase == "climb":
            return phase == "take_off" and watcher.height > self._share * self._height
        if self._case.phase == "search":
            return phase == "searching" and elapsed > 0.5 * self._share
        if self._case.phase == "approach":
            return phase == "tracking" and elapsed > self._share * (self._duration - 0.2)
        if self._case.phase == "contact":
            return phase in ("tracking", "verifying") and (self._pad.normal @ (watcher.position - self._pad.p_WS)) < CONTACT_DISTANCE
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
    launches = imageless_launches(scenario, case.seed, str(source), lockstep, overrides=hold)
    with domain_in_environment(sorted(DOMAINS, key=lambda d: (d - case.seed) % len(DOMAINS))) as domain:
        group, pilot = Group(launches, case, folder, domain), MissionClient()
        try:
            watcher = Watcher(pilot)
            injector = _FaultInjector(case, group, watcher, scenario.mission.takeoff_height, pad_surface(scenario, 0.0))
            group.start_all()
            limit = time.monotonic() + READY_TIMEOUT
            while missing := group.nodes - pilot.visible_nodes():
                if time.monotonic() > limit or group.ended_processes():
                    raise PerchError(f"not ready: {', '.join(group.ended_processes() or sorted(missing))}; logs: {folder}")
            try:
                result = pilot.fly(scenario, injector.on_phase, injector.check_goal, stall_timeout=STALL_TIMEOUT)
                goal = f"{result.outcome}: {result.message}"
            except PerchError as error:
                goal = str(error)
            if goal != UNANSWERED:
                injector.received.append((time.time(), goal))
            end = _wait_for_end(pilot, watcher, injector)
            ended = tuple(name for name in group.ended_processes() if name != case.node or case.fault == "restart" or case.fault not in PROCESS)
        finally:
            group.stop()
            pilot.close()
            gc.collect()  # a goal is a cycle that holds the pilot's DDS participant
            left = group.leftovers()
    found = (first_report(case, injector.injection_wall_time, group.log_lines(), injector.received)
             if injector.injection_wall_time is not None else None)
    impacts = [c.normal_speed for c in watcher.contacts if c.state in (ContactState.COLLISION, ContactState.GROUND)
               and injector.injection_time is not None and 1e-9 * c.stamp >= injector.injection_time]
    impact = round(max(impacts, default=0.0), 2)
    after, words = (None, "") if found is None else (round(found[0], 2), found[1][:300])
    return Row(*case, case.seed, commit, injector.injection_time, injector.before[:3], judged_end(end, impact),
               after, words, goal[:300], impact, ended, left, round(time.monotonic() - began, 1))


def _wait_for_end(pilot: MissionClient, watcher: Watcher, injector: _FaultInjector) -> str:
    """Wait until an end lasts and the time to report the fault is over; return the end."""
    limit, since, last = time.monotonic() + TIME_LIMIT, watcher.time, ""
    while time.monotonic() < limit:
        pilot.spin(0.05)
        injector.apply_if_due()
        injector.received += [(time.time(), words) for words in pilot.node_events()]
        now = watcher.situation()
        if now is None:
            continue
        found = ending(now)
        if found != last:
            last, since = found, watcher.time
        if found in SAFE and watcher.time - since > SETTLING_TIME and injector.report_time_over:
            return found
    return f"{last}, not stable" if last in SAFE else last
