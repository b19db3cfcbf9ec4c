"""Processes of one flight with a fault: start, signals, end, and what they leave behind."""

from __future__ import annotations

import json
import os
import signal
import time
from contextlib import suppress
from pathlib import Path

from perch_eval.fork_server import alive, session, start
from perch_eval.graph_faults.cases import DISTURBED_CHANNELS, LOCKSTEP, PROCESS, Case
from perch_eval.graph_faults.relay_node import DIRECT
from perch_eval.modelled_sight_node import MODULE, NODES as MODELLED_NODES
from perch_eval.node_launch import NodeLaunch
from perch_eval.nodes import ros_arguments
from perch_eval.shared_memory import PORT, SharedMemory, port_files, segment

STOP_TIMEOUTS = (5.0, 2.0)  # for a process to end after SIGINT and after SIGKILL [s]
CLEANUP_TIME = 10.0  # for resources of processes to vanish after their end, on a busy machine [s]
NICE = 10            # of flights in lockstep: those in real time go first


class Group:
    """Processes of one flight.

    Attributes:
        pids: name of the process (its node, or `composed`) -> its present id.
        nodes: fully qualified names of the nodes.
    """

    def __init__(self, launches: tuple[NodeLaunch, ...], case: Case, folder: Path, domain: int) -> None:
        """
        Args:
            launches: nodes of the flight.
            case: determines which nodes have their own process, and which messages pass the relay.
            folder: receives parameters and logs.
            domain: ROS domain.
        """
        self._folder, self._domain, self._nice = folder, domain, NICE if case.mode == LOCKSTEP else 0
        self._commands = {one.name: (f"{MODULE}:{one.name.upper()}" if one.name in MODELLED_NODES else f"{one.module}:NODE",
                                     ros_arguments(one, folder)) for one in launches}
        self.nodes = {f"/{name}" for name in self._commands}
        together = [] if case.separate_processes else [one for one in launches if one.name not in (*MODELLED_NODES, case.node)]
        if together:
            plan = [{"name": one.name, "module": one.module, "arguments": self._commands.pop(one.name)[1]} for one in together]
            (folder / "composed.json").write_text(json.dumps(plan))
            self._commands["composed"] = "perch_eval.composed_node:main", [str(folder / "composed.json")]
        if case.fault not in PROCESS:
            channels = DISTURBED_CHANNELS[case.node]
            self._commands[case.node][1][1:1] = [text for channel in channels for text in ("-r", f"{channel}:={DIRECT}/{channel}")]
            self._commands["relay"] = "perch_eval.graph_faults.relay_node:main", [*channels, "--ros-args"]
            self.nodes.add("/relay")
        self.pids: dict[str, int] = {}
        self._sessions: list[int] = []
        self._killed: tuple[str, ...] = ()  # processes that did not end after SIGINT
        self._memory = SharedMemory()
        self._ports_before = port_files(domain)

    def start(self, name: str) -> None:
        """Start or restart a process."""
        what, arguments = self._commands[name]
        pid = start(what, arguments, self._folder / f"{name}.log", {"ROS_DOMAIN_ID": str(self._domain)}, "perch_eval.graph_faults.preload")
        os.setpriority(os.PRIO_PROCESS, pid, self._nice)
        self.pids[name] = pid
        self._sessions.append(pid)

    def start_all(self) -> None:
        """Start all processes."""
        for name in self._commands:
            self.start(name)

    def signal(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process."""
        self._memory.observe(self.pids.values())
        os.kill(self.pids[name], number)

    def ended_processes(self) -> tuple[str, ...]:
        """Return the names of processes that have ended."""
        return tuple(name for name, pid in self.pids.items() if not alive(pid))

    def log_lines(self) -> list[str]:
        """Return the lines of all logs."""
        return [line for name in self._commands for line in (self._folder / f"{name}.log").read_text(errors="replace").splitlines()]

    def stop(self) -> None:
        """End all processes. Call it before the pilot is closed, so that the pilot's shared memory is cleaned, too."""
        self._memory.observe((*self.pids.values(), os.getpid()))
        running = [pid for pid in self.pids.values() if alive(pid)]
        for number, timeout in zip((signal.SIGINT, signal.SIGKILL), STOP_TIMEOUTS):
            if number == signal.SIGKILL:
                self._killed = tuple(name for name, pid in self.pids.items() if pid in running)
            for pid in running:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGCONT)
                    os.kill(pid, number)
            end = time.monotonic() + timeout
            while time.monotonic() < end and (running := [pid for pid in running if alive(pid)]):
                self._memory.observe(running)
                time.sleep(0.02)

    def leftovers(self) -> tuple[str, ...]:
        """Clean shared memory, which a killed process cannot, and return what remains and what had to be killed at the end, as text.
        All processes must be stopped and the pilot closed."""
        end = time.monotonic() + CLEANUP_TIME
        while True:  # threads of a process that has ended may hold what it had open for a moment
            self._memory.clean()
            processes = [f"process {pid}" for leader in self._sessions for pid in session(leader)]
            found = (*processes, *self._sockets(), *self._shared_memory())
            if not found or time.monotonic() > end:
                return (*(f"process {name} after SIGINT" for name in self._killed), *found)
            time.sleep(0.1)

    def _sockets(self) -> list[str]:
        prefix = f"perch-lockstep-{os.getuid()}-{self._domain}-"
        return [f"socket {line.split()[-1]}" for line in Path("/proc/net/unix").read_text().splitlines() if prefix in line]

    def _shared_memory(self) -> list[str]:
        """Return segments of these processes, or of a port of their domain, that are unused or whose creator has ended."""
        ports = port_files(self._domain) - self._ports_before  # other ports are shared with other domains
        found = ports | {Path(name) for name in self._memory.segments if Path(name).exists() and not PORT.match(Path(name).name)}
        unused = SharedMemory().unused(map(segment, found))
        return [f"shared memory {file.name}" for file in sorted(found) if segment(file) in unused]
