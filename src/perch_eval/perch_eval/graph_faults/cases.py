"""Cases of the campaign: fault, node, phase and mode; criteria for a safe end and for a reported fault."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

from perch_sim.contact import CRASH_SPEED

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
"""Channels that are disturbed in real time, by publishing node. The planners answer requests and publish nothing that is used."""
PHASES = ("climb", "search", "approach", "contact", "perched")
LOCKSTEP, REAL_TIME = "lockstep", "real time"
MODES = (LOCKSTEP, REAL_TIME)
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
"""Patterns that identify a struck node in a message: its name, or a channel that it publishes."""
_FAULT_WORDS = re.compile(r"\b(no|not|never|lost|gone|silent|waiting|without|refused|stopped|missed|descen\w+|landing|ended|dropped|"
                          r"restarted|back)\b", re.IGNORECASE)
_ROUTINE_MESSAGES = re.compile(r"looking for the target|waiting for the estimator$")
"""Messages that the mission sends in every flight; they do not report a fault."""
_LINE = re.compile(r"\[(?P<level>[A-Z]+)\] \[(?P<time>\d{9,}\.\d+)\] \[(?P<node>[\w.]+)\]: (?P<text>.*)")


class Case(NamedTuple):
    """One case: a fault of a node in a phase of a flight."""

    fault: str
    node: str
    phase: str
    mode: str

    @property
    def name(self) -> str:
        """Name of the case, in pages and files."""
        return f"{self.fault} {self.node}, {self.phase}, {self.mode}"

    @property
    def seed(self) -> int:
        """Seed of the flight, and of the time of the fault within the phase."""
        return int(self._digest[:7], 16)

    @property
    def separate_processes(self) -> bool:
        """Whether every node has its own process; otherwise the struck one has, and most others share one, as in `demo.py`."""
        return self.seed % 4 == 0

    @property
    def _digest(self) -> str:
        return hashlib.sha256(self.name.encode()).hexdigest()


def cases() -> list[Case]:
    """Return all cases in a fixed, mixed order, so that the first n are a sample of all."""
    found = [Case(*one) for one in product(PROCESS, NODES, PHASES, MODES)]
    found += [Case(fault, node, phase, REAL_TIME) for fault, node, phase in product(TRAFFIC, DISTURBED_CHANNELS, ("search", "approach"))]
    return sorted(found, key=lambda case: case._digest)


def judged_end(end: str, impact: float) -> str:
    """Return the end of a flight, `crashed` where an impact after the fault [m/s] was faster than the vehicle survives."""
    return "crashed" if impact > CRASH_SPEED else end


def first_report(case: Case, fault_time: float, lines: Iterable[str], received: Iterable[tuple[float, str]]) -> tuple[float, str] | None:
    """Return the delay [s] and text of the first report that names the struck node or its messages; None: there is none.

    Args:
        case: the case; log lines of the struck node itself do not count.
        fault_time: time of the fault, seconds since the epoch.
        lines: lines of all logs, each with level, seconds since the epoch and node.
        received: (seconds since the epoch, text) received by the pilot, which sent the goal.
    """
    pattern = re.compile(NODE_PATTERNS[case.node], re.IGNORECASE)
    found = [(time - fault_time, f"pilot: {text}") for time, text in received
             if time >= fault_time and pattern.search(text) and _FAULT_WORDS.search(text) and not _ROUTINE_MESSAGES.match(text)]
    for line in filter(None, map(_LINE.match, lines)):
        after, text = float(line["time"]) - fault_time, line["text"]
        if line["node"] != case.node and after >= 0.0 and pattern.search(text) and (_FAULT_WORDS.search(text) or line["level"] != "INFO"):
            found.append((after, f"{line['node']}: {text}"))
    return min(found, default=None)
