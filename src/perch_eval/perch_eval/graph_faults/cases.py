"""Which faults strike which node when, and what counts as a safe and named end."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

PROCESS = {
    "kill": "SIGKILL; the node stays away",
    "stop": "SIGSTOP; the node hangs until the flight has ended",
    "restart": "SIGKILL, and the node is started again at once",
}
TRAFFIC = {
    "delay": "what the node publishes comes 0.2 s later",
    "drop": "half of what the node publishes is lost, at random",
    "duplicate": "what the node publishes comes twice",
    "reorder": "of two messages that the node publishes the second comes first",
}
FAULTS = PROCESS | TRAFFIC
NODES = ("vio_model", "estimator", "target_localizer", "perching_planner", "controller", "mission")
DISTURBED_CHANNELS = {
    "vehicle": ("imu/data_raw",),
    "vio_model": ("vio/state", "vio/odometry"),
    "estimator": ("odometry", "estimator/status"),
    "target_localizer": ("target/pose",),
    "controller": ("motor_command", "controller/status"),
    "mission": ("trajectory", "controller/command"),
}
"""Node -> channels whose messages are disturbed, in real time. The planner answers requests, it publishes no messages for other nodes."""
PHASES = ("climb", "search", "approach", "contact", "perched")
LOCKSTEP, REAL_TIME = "lockstep", "real time"
MODES = (LOCKSTEP, REAL_TIME)
SAFE = ("hovering", "landed", "perched", "motors off")
"""Ends that are safe; `motors off`: on the ground, after a fall or lying there."""
REPORT_LIMIT = 5.0  # wall-clock time from the fault within which it must be reported [s]

NODE_PATTERNS = {
    "vehicle": r"\bimu\b|imu/data_raw",
    "vio_model": r"\bvio",
    "estimator": r"estimator|odometry",
    "target_localizer": r"target",
    "perching_planner": r"plan_perch|planner",
    "controller": r"controller|motor_command|disarmed",
    "mission": r"\bmission\b",
}
"""Node -> pattern of a report that names it or its messages: its name, or one of its channels."""
_FAULT_WORDS = re.compile(r"\b(no|not|never|lost|gone|silent|waiting|without|refused|stopped|missed|descen\w+|landing|ended|dropped|"
                          r"restarted|back)\b", re.IGNORECASE)
_ROUTINE_MESSAGES = re.compile(r"looking for the target|waiting for the estimator$")
"""Messages of the mission in every flight."""
_LINE = re.compile(r"\[(?P<level>[A-Z]+)\] \[(?P<time>\d{9,}\.\d+)\] \[(?P<node>[\w.]+)\]: (?P<text>.*)")


class Case(NamedTuple):
    """One fault."""

    fault: str
    node: str
    phase: str
    mode: str

    @property
    def name(self) -> str:
        """For files and people."""
        return f"{self.fault} {self.node}, {self.phase}, {self.mode}"

    @property
    def seed(self) -> int:
        """Of the flight, and of the moment within the phase."""
        return int(self._digest[:7], 16)

    @property
    def separate_processes(self) -> bool:
        """Whether every node has a process of its own; otherwise the struck one has, and most of the others share one, as in `demo.py`."""
        return self.seed % 4 == 0

    @property
    def _digest(self) -> str:
        return hashlib.sha256(self.name.encode()).hexdigest()


def cases() -> list[Case]:
    """All of them, so mixed that the first n are a sample of all."""
    found = [Case(*one) for one in product(PROCESS, NODES, PHASES, MODES)]
    found += [Case(fault, node, phase, REAL_TIME) for fault, node, phase in product(TRAFFIC, DISTURBED_CHANNELS, ("search", "approach"))]
    return sorted(found, key=lambda case: case._digest)


class Situation(NamedTuple):
    """The vehicle at one moment, by the truth.

    Attributes:
        height: of the centre of mass above where it stood before the flight [m].
        speed: [m/s].
        tilt: [deg].
        rotors: of the fastest one [rad/s].
        held: velcro or gripper holds.
        hovers: reported by the controller.
    """

    height: float
    speed: float
    tilt: float
    rotors: float
    held: bool
    hovers: bool


def ending(now: Situation) -> str:
    """How a flight has ended, by the truth; a hover must be reported by the controller, too."""
    if now.held and now.speed < 0.1 and now.rotors < 50.0:
        return "perched"
    if now.rotors < 50.0 and now.height < 0.15 and now.speed < 0.1:
        return "landed" if now.tilt < 20.0 else "motors off"
    if now.hovers and now.speed < 0.5 and now.tilt < 20.0 and now.height > 0.2:
        return "hovering"
    return "held with running motors" if now.held else "on the ground with running motors" if now.height < 0.15 else "in flight"


def first_report(case: Case, fault_time: float, lines: Iterable[str], received: Iterable[tuple[float, str]]) -> tuple[float, str] | None:
    """Time after the fault [s] and text of its first report; None: there is none.

    Args:
        case: the fault; its node does not count as a source.
        fault_time: when, seconds since the epoch.
        lines: of all logs, each with level, seconds since the epoch, node.
        received: (seconds since the epoch, text) of who sent the goal.
    """
    pattern = re.compile(NODE_PATTERNS[case.node], re.IGNORECASE)
    found = [(time - fault_time, f"pilot: {text}") for time, text in received
             if time >= fault_time and pattern.search(text) and _FAULT_WORDS.search(text) and not _ROUTINE_MESSAGES.match(text)]
    for line in filter(None, map(_LINE.match, lines)):
        after, text = float(line["time"]) - fault_time, line["text"]
        if line["node"] != case.node and after >= 0.0 and pattern.search(text) and (_FAULT_WORDS.search(text) or line["level"] != "INFO"):
            found.append((after, f"{line['node']}: {text}"))
    return min(found, default=None)
