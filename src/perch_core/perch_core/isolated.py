"""Jobs in a process that can be killed: a job that hangs ends at its time limit and does not block the caller. No ROS.

This module is the caller's side. `isolated_process` is the other side: a supervisor that has loaded everything, and its child,
which executes the jobs one after the other. After a job was stopped or crashed, the supervisor forks a new child.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from multiprocessing.connection import Connection, Pipe, wait
from typing import Any

from perch_core.job import Job, JobFailed, JobStopped

MEMORY = 4 << 30
"""Address space of a job's process [byte]; numpy, CasADi and compiled kernels use 0.4 GiB of it before the first job."""
START_TIMEOUT = 300.0
"""Time-out for the supervisor's start [s]; the first start on a machine compiles kernels."""
COMMAND = (sys.executable, "-m", "perch_core.isolated_process")
WAITING_MAX = 64
"""Greatest number of queued jobs; further jobs are refused."""
_GRACE = 1.0  # [s] past a job's limit, within which the supervisor must have stopped it
_HEADER = struct.Struct("<d")  # of a job on the pipe: its limit [s]; what follows is pickled (function, arguments)


@dataclass
class _Task:
    """A submitted job: the serialised call, its limit [s], its deadline on the monotonic clock [s], and the caller's future."""

    name: str
    payload: bytes
    limit: float
    end: float
    future: Future[Any] = field(default_factory=Future)


class IsolatedRunner:
    """Runs jobs one after the other in another process, each within its time limit.

    The constructor returns at once. Limits count from `submit`: jobs submitted before `wait_ready` may time out during start-up.
    `close` ends all processes, and so does the end of the caller. Ctrl-C in the caller's terminal does not reach them.
    """

    def __init__(self, preload: Callable[[], Any] | None = None, memory: int = MEMORY, command: tuple[str, ...] = COMMAND) -> None:
        """
        Args:
            preload: module-level function, picklable; called once in the supervisor, so that every child inherits what it loads.
            memory: address space of a job's process [byte].
            command: starts the supervisor; the file descriptor of its end of the pipe and this process's id are appended.
        """
        self._preload = pickle.dumps(preload)
        self._setup = tuple(sys.path), memory  # first message to the supervisor
        self._command = command
        self._tasks: deque[_Task] = deque()
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: Connection | None = None
        self._lock = threading.Lock()  # around `_closing` and `_process`
        self._closing = False
        self._started, self._ready, self._problem = threading.Event(), False, ""
        self._wake_sender, self._wake_receiver = socket.socketpair()
        self._wake_sender.setblocking(False)
        # The supervisor ends with the thread that starts it, which is this one.
        self._thread = threading.Thread(target=self._serve, name="isolated jobs", daemon=True)
        self._thread.start()

    def wait_ready(self) -> bool:
        """Wait until the supervisor has loaded everything; False after `START_TIMEOUT`.

        Raises:
            JobFailed: the supervisor could not start; the message has the reason.
        """
        if not self._started.wait(START_TIMEOUT):
            return False
        if self._problem:
            raise JobFailed(self._problem)
        return self._ready

    @property
    def pid(self) -> int:
        """Process id of the supervisor, the leader of its own process group; 0: no supervisor has been started."""
        process = self._process
        return 0 if process is None else process.pid

    def submit(self, job: Job) -> Future[Any]:
        """Submit a job; returns at once.

        Args:
            job: the job; its `then` is not called here but by the host.

        Returns:
            A future, completed by another thread with the function's result, or with the error that ended the job: the
            function's own `PerchError`, `JobStopped` or `JobFailed`.
        """
        now = time.monotonic()
        limit = inf if job.limit is None else float(job.limit)
        name = getattr(job.function, "__qualname__", type(job.function).__name__)
        try:
            task = _Task(name, pickle.dumps((job.function, job.arguments)), limit, now + limit)
        except Exception as error:  # what pickle raises depends on what it is given
            failed: Future[Any] = Future()
            failed.set_exception(JobFailed(f"{name}: cannot be sent to another process: {error}"))
            return failed
        with self._lock:
            if self._closing or len(self._tasks) >= WAITING_MAX:
                reason = "the runner is closed" if self._closing else f"{WAITING_MAX} others are waiting"
                task.future.set_exception(JobFailed(f"{name}: {reason}"))
                return task.future
            self._tasks.append(task)
            self._wake_thread()
        return task.future

    def close(self) -> None:
        """End the processes, even during a job; jobs that have not ended fail."""
        with self._lock:
            if not self._closing:
                self._closing = True
                self._wake_thread()
                self._kill()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _wake_thread(self) -> None:
        """Wake the runner's thread, so that it checks for work."""
        with suppress(BlockingIOError):  # it has been called often enough
            self._wake_sender.send(b".")

    # -- the runner's thread -------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        self._start()
        while not self._closing:
            if self._ready and self._tasks:
                self._run(self._tasks.popleft())
                continue
            if self._wait_for_data():
                self._receive_status()
            if self._pipe is None and self._tasks and not self._closing:
                self._start()  # the last start failed: once more for this job
        self._end()
        for task in self._tasks:
            _fail(task, JobFailed(f"{task.name}: the runner was closed"))
        for end in (self._wake_sender, self._wake_receiver):
            end.close()

    def _wait_for_data(self, until: float = inf) -> bool:
        """Wait for the supervisor, a wake-up call or a time; queued jobs whose limit has passed fail.

        Args:
            until: latest time on the monotonic clock [s].

        Returns:
            Whether the supervisor's pipe has data.
        """
        deadline = min([until, *(task.end for task in self._waiting())])
        pipes: list[socket.socket | Connection] = [self._wake_receiver] if self._pipe is None else [self._wake_receiver, self._pipe]
        ready = wait(pipes, None if deadline == inf else max(0.0, deadline - time.monotonic()))
        if self._wake_receiver in ready:
            self._wake_receiver.recv(4096)
        for task in [task for task in self._waiting() if task.end <= time.monotonic()]:
            with self._lock:
                self._tasks.remove(task)
            _fail(task, self._timed_out(task))
        return self._pipe in ready

    def _waiting(self) -> list[_Task]:
        """Return a copy of the queue; other threads may append to the queue meanwhile."""
        with self._lock:
            return list(self._tasks)

    def _start(self) -> None:
        """Start a supervisor and send it its set-up and preload; if the system refuses it, all jobs fail."""
        self._ready, self._problem = False, ""
        self._started.clear()
        try:
            self._pipe, child_end = Pipe()
            with child_end, self._lock:
                if self._closing:
                    return
                command = [*self._command, str(child_end.fileno()), str(os.getpid())]
                # BLAS on one thread: so do all nodes, and a process with threads cannot be forked.
                environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
                self._process = subprocess.Popen(command, pass_fds=(child_end.fileno(),), process_group=0, env=environment)
        except OSError as error:
            self._fail_start(str(error))
            return
        with suppress(OSError):  # it ended already: `_receive_status` finds out
            self._pipe.send(self._setup)
            self._pipe.send_bytes(self._preload)

    def _fail_start(self, reason: str) -> None:
        """Fail all jobs, as the supervisor could not start."""
        self._problem = f"the process for isolated jobs did not start: {reason}"
        self._end()
        while self._tasks:
            _fail(self._tasks.popleft(), JobFailed(self._problem))
        self._started.set()

    def _receive_status(self) -> None:
        """Receive the supervisor's report that it is ready, or why not; if it has ended after it was ready, start another one."""
        assert self._pipe is not None
        try:
            answer = self._pipe.recv_bytes().decode()
        except (EOFError, OSError):
            answer, was_ready = "it ended", self._ready
            self._end()
            if was_ready:
                self._start()
                return
        if answer == "ready":
            self._ready = True
            self._started.set()
        else:
            self._fail_start(answer)

    def _run(self, task: _Task) -> None:
        """Run one job and complete its future."""
        remaining = task.end - time.monotonic()
        if remaining <= 0.0:
            _fail(task, self._timed_out(task))
            return
        if not task.future.running() and not task.future.set_running_or_notify_cancel():
            return
        assert self._pipe is not None
        try:
            self._pipe.send_bytes(_HEADER.pack(remaining) + task.payload)
            while not self._wait_for_data(task.end + _GRACE):
                if time.monotonic() >= task.end + _GRACE:
                    raise TimeoutError
            kind, answer = _decode_answer(self._pipe.recv_bytes())
        except TimeoutError:
            self._restart()
            kind, answer = b"T", "its process did not answer"
        except EOFError:
            self._restart()
            kind, answer = b"F", "its process ended"
        except OSError:  # the supervisor ended before it took the job
            self._restart()
            self._tasks.appendleft(task)
            return
        except Exception as error:  # no memory for the answer: this thread must go on
            self._restart()
            kind, answer = b"F", f"its answer cannot be received: {type(error).__name__}: {error}"
        if kind == b"A":
            task.future.set_result(answer)
        elif kind == b"E":
            task.future.set_exception(answer)
        elif kind == b"T":
            task.future.set_exception(JobStopped(f"{task.name}: stopped after {task.limit:g} s"))
        else:
            task.future.set_exception(JobFailed(f"{task.name}: {answer}"))

    def _timed_out(self, task: _Task) -> JobStopped:
        cause = "other jobs were running" if self._ready else "its process was not ready"
        return JobStopped(f"{task.name}: not begun within {task.limit:g} s: {cause}")

    def _restart(self) -> None:
        self._end()
        if not self._closing:
            self._start()

    def _kill(self) -> None:
        if self._process is not None and self._process.poll() is None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # its own group: supervisor, child and what they started

    def _end(self) -> None:
        """End the supervisor and the processes that it has started."""
        with self._lock:
            self._ready = False
            if self._process is not None:
                if self._process.poll() is None:
                    self._kill()
                self._process.wait()
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None


def _decode_answer(answer: bytes) -> tuple[bytes, Any]:
    """Return kind and content of an answer: A the result, E the exception, T stopped at the limit, F failed with a message."""
    kind, content = answer[:1], answer[1:]
    if kind in (b"T", b"F"):
        return kind, content.decode()
    try:
        return kind, pickle.loads(content)
    except Exception as error:  # what pickle raises depends on what it is given
        return b"F", f"its answer cannot be read: {error}"


def _fail(task: _Task, error: Exception) -> None:
    if task.future.running() or task.future.set_running_or_notify_cancel():
        task.future.set_exception(error)
