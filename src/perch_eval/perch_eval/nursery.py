"""Starts nodes in a tenth of a second: each process is forked from one that has loaded their code. Knows nothing of ROS.

A node's own start takes seconds of processor time for imports and compiled code, campaigns over ROS start thousands. What is forked
is a process of its own: its own session, sockets, shared memory, signals and log.

    nursery = Nursery(modules)
    pid = nursery.start("perch_control.controller_node:NODE", ["--ros-args", ...], log, {"ROS_DOMAIN_ID": "50"})
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path

from perch_core.errors import PerchError
from perch_core.processes import end_with_parent, freeze_heap
from perch_core.registry import resolved


class Nursery:
    """The caller's side; `close` ends everything that was started, and so does the end of the caller."""

    def __init__(self, modules: Sequence[str], scenarios: Sequence[str] = ()) -> None:
        """
        Args:
            modules: what is loaded before anything is forked.
            scenarios: flown in process once before, which loads compiled code.
        """
        self._process = subprocess.Popen([sys.executable, "-m", "perch_eval.nursery"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                         text=True, process_group=0)
        self._tell({"modules": list(modules), "scenarios": list(scenarios)})

    def _tell(self, order: Mapping[str, object]) -> int:
        try:
            self._process.stdin.write(json.dumps(order) + "\n")
            self._process.stdin.flush()
            return int(self._process.stdout.readline())
        except (OSError, ValueError):
            raise PerchError(f"the process that starts nodes has ended (exit code {self._process.wait(5.0)})") from None

    def start(self, what: str, arguments: Sequence[str], log: Path, environment: Mapping[str, str]) -> int:
        """Start a node.

        Args:
            what: `module:name` of something with `main()`, or of a function.
            arguments: of its command line.
            log: receives what it writes.
            environment: on top of the caller's.

        Returns:
            Its process id, which leads a session of its own.
        """
        return self._tell({"what": what, "arguments": list(arguments), "log": str(log), "environment": dict(environment)})

    def close(self) -> None:
        """End everything."""
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def alive(pid: int) -> bool:
    """Whether a process runs, or is stopped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def session(leader: int) -> list[int]:
    """The living processes of a session."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of = file.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(of) == leader and state not in "ZX":
            found.append(int(file.parent.name))
    return found


def _serve() -> None:
    """Fork a node for every line on the standard input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent(signal.SIGKILL)
    first = json.loads(sys.stdin.readline())
    for module in first["modules"]:
        importlib.import_module(module)
    for name in first["scenarios"]:
        from perch_eval.in_process import fly
        from perch_sim.scenario import load_scenario
        fly(load_scenario(name), 1)
    freeze_heap()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody asks how a child ended: none stays as a zombie
    print(os.getpid(), flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        pid = os.fork()
        if pid == 0:
            _become(order)
        print(pid, flush=True)


def _become(order: dict) -> None:
    """Be the node; never returns."""
    code = 1
    try:
        os.setsid()
        end_with_parent(signal.SIGKILL)
        for number in (signal.SIGINT, signal.SIGCHLD):
            signal.signal(number, signal.SIG_DFL)
        log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for target, source in ((0, nothing), (1, log), (2, log)):
            os.dup2(source, target)
        os.closerange(3, 256)
        os.environ.update(order["environment"])
        sys.argv = [order["what"], *order["arguments"]]
        what = resolved(order["what"])
        getattr(what, "main", what)()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve()
