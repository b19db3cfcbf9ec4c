"""Jobs in a process that can be killed: answers, typed errors in time from what hangs or crashes, and nothing left behind."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from perch_core import isolated
from perch_core.job import Job, JobFailed, JobStopped
from perch_core.errors import ConfigError, PerchError, PlanningRefusal
from perch_core.isolated import IsolatedRunner

JOBS = """
import ctypes, os, sys, time
from perch_core.errors import PlanningRefusal

LOADED = []

def load(what):
    LOADED.append(what)

def cannot_load():
    raise RuntimeError("no such solver")

def loaded():
    return LOADED, os.getpid(), os.getppid()

def double(x):
    return 2 * x

def hang(begun=None):
    if begun:
        open(begun, "w").close()
    while True:
        pass

def spawn():
    return os.spawnlp(os.P_NOWAIT, "sleep", "sleep", "1000")

def crash():
    ctypes.string_at(0)

def leave():
    os._exit(3)

def eat():
    return len(b"x" * (1 << 40))

def eat_in_pieces():
    kept = []
    while True:
        kept.append(bytearray(1 << 26))

def casadi_eats():
    try:
        raise RuntimeError("std::bad_alloc")
    except RuntimeError as error:
        raise PlanningRefusal("solver", "numerics", -1.0, f"planning failed: {error}") from error

def unsendable():
    return lambda: 0

def refuse():
    raise PlanningRefusal("box", "height", -0.5, "too high")

def fail():
    raise IndexError("list index out of range")
"""


@pytest.fixture(scope="module")
def jobs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ModuleType]:
    folder = tmp_path_factory.mktemp("jobs")
    (folder / "isolated_jobs.py").write_text(JOBS)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        import isolated_jobs

        yield isolated_jobs
        del sys.modules["isolated_jobs"]


@pytest.fixture
def runner(jobs: ModuleType) -> Iterator[IsolatedRunner]:
    made = IsolatedRunner(partial(jobs.load, "kernels"))
    assert made.wait_ready()
    yield made
    made.close()


@pytest.fixture(scope="module")
def lasting(jobs: ModuleType) -> Iterator[IsolatedRunner]:
    """One for all tests after which it goes on."""
    made = IsolatedRunner(partial(jobs.load, "kernels"))
    assert made.wait_ready()
    yield made
    made.close()


def submit(runner: IsolatedRunner, function: Callable[..., Any], *arguments: Any, limit: float | None = 60.0) -> Future[Any]:
    return runner.submit(Job(function, arguments, lambda _: None, limit, isolated=True))


def hanging(runner: IsolatedRunner, jobs: ModuleType, folder: Path) -> Future[Any]:
    """A job that hangs and has begun to."""
    future = submit(runner, jobs.hang, str(folder / "begun"))
    while not (folder / "begun").exists():
        time.sleep(0.01)
    return future


def gone(pid: int) -> bool:
    """Whether a process group has ended, waiting for it for a minute."""
    for _ in range(3000):
        try:
            os.killpg(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False


def test_answers_come_from_a_child_that_has_what_was_preloaded_and_stays(lasting: IsolatedRunner, jobs: ModuleType) -> None:
    assert submit(lasting, jobs.double, 21).result(120.0) == 42
    first, second = (submit(lasting, jobs.loaded).result(120.0) for _ in range(2))
    assert first == second and first[0] == ["kernels"]
    assert os.getpid() not in first[1:] and first[2] == lasting.pid


def test_submit_returns_at_once_and_another_thread_tells_completion(lasting: IsolatedRunner, jobs: ModuleType) -> None:
    told, done = [], threading.Event()
    stopped = submit(lasting, jobs.hang, limit=0.3)
    assert not stopped.done()
    stopped.add_done_callback(lambda future: (told.append(threading.current_thread()), done.set()))
    assert done.wait(120.0) and told[0] is not threading.current_thread()


def test_jobs_may_come_while_the_runner_looks_through_those_that_wait(jobs: ModuleType) -> None:
    runner = IsolatedRunner(command=(sys.executable, "-c", "import time; time.sleep(60)"))  # never ready, so that jobs wait
    answers: list[Future[Any]] = []

    class Waiting(isolated._Task):
        def __getattribute__(self, name: str) -> Any:
            if name == "end" and len(answers) < 20:
                answers.append(submit(runner, jobs.double, 1, limit=0.2))
            return super().__getattribute__(name)

    runner._tasks.append(Waiting("double", b"", 0.2, time.monotonic() + 0.2))
    first = submit(runner, jobs.double, 1, limit=0.2)
    with pytest.raises(JobStopped):
        first.result(timeout=30)
    assert len(answers) == 20, "they came while it looked"
    for answer in answers:
        with pytest.raises(JobStopped):
            answer.result(timeout=30)
    runner.close()


def test_a_job_is_stopped_at_its_limit_and_the_next_is_done(lasting: IsolatedRunner, jobs: ModuleType) -> None:
    for _ in range(3):
        with pytest.raises(JobStopped, match="hang: stopped after 0.2 s"):
            submit(lasting, jobs.hang, limit=0.2).result(120.0)
        assert submit(lasting, jobs.double, 1).result(120.0) == 2


def test_a_limit_counts_from_the_submission_whatever_is_being_done(runner: IsolatedRunner, jobs: ModuleType) -> None:
    under_way = submit(runner, jobs.hang, limit=3600.0)
    late = submit(runner, jobs.double, 1, limit=0.2)
    with pytest.raises(JobStopped, match="not begun within 0.2 s: other jobs"):
        late.result(120.0)
    assert not under_way.done(), "it is answered while the other job goes on"


@pytest.mark.parametrize(("name", "error", "words"), [
    ("crash", JobFailed, "crashed .SIGSEGV."), ("leave", JobFailed, "exit status 3"), ("eat", JobFailed, "out of memory: .* 4 GiB"),
    ("unsendable", JobFailed, "cannot be sent"),
    ("fail", JobFailed, "IndexError: list index out of range"), ("refuse", PlanningRefusal, "too high"),
])
def test_whatever_ends_a_job_is_a_typed_error_and_the_next_is_done(lasting: IsolatedRunner, jobs: ModuleType, name: str, error: type,
                                                                   words: str) -> None:
    with pytest.raises(error, match=words) as raised:
        submit(lasting, getattr(jobs, name)).result(60)
    assert isinstance(raised.value, PerchError)
    assert submit(lasting, jobs.double, 1).result(120.0) == 2


def test_the_memory_of_a_job_is_bounded(jobs: ModuleType) -> None:
    runner = IsolatedRunner(memory=512 << 20)
    try:
        with pytest.raises(JobFailed, match="out of memory: the limit of its process is 0.5 GiB"):
            submit(runner, jobs.eat_in_pieces, limit=60.0).result(90)
        assert submit(runner, jobs.double, 1).result(60) == 2
    finally:
        runner.close()


@pytest.mark.parametrize("name", ["eat", "casadi_eats"])
def test_a_process_that_ran_out_of_memory_is_replaced(lasting: IsolatedRunner, jobs: ModuleType, name: str) -> None:
    _, child, supervisor = submit(lasting, jobs.loaded).result(120.0)
    with pytest.raises(JobFailed, match="out of memory: the limit of its process is 4 GiB"):
        submit(lasting, getattr(jobs, name)).result(60)
    loaded, other, same = submit(lasting, jobs.loaded).result(120.0)
    assert other != child and (loaded, same) == (["kernels"], supervisor)


def test_a_job_that_cannot_be_sent_says_so(lasting: IsolatedRunner) -> None:
    with pytest.raises(JobFailed, match="cannot be sent"):
        submit(lasting, lambda: 0).result(120.0)


def test_errors_with_several_arguments_survive_the_way() -> None:
    refusal = pickle.loads(pickle.dumps(PlanningRefusal("box", "height", -0.5, "too high")))
    assert (refusal.code, refusal.constraint, refusal.margin, str(refusal)) == ("box", "height", -0.5, "too high")
    error = pickle.loads(pickle.dumps(ConfigError("a.yaml", "mass", "0 is not > 0 kg")))
    assert (error.key, str(error)) == ("mass", "a.yaml: mass: 0 is not > 0 kg")


@pytest.mark.parametrize("whom", ["supervisor", "child"])
def test_killed_in_the_middle_of_a_job_it_fails_and_the_next_is_done(runner: IsolatedRunner, jobs: ModuleType, tmp_path: Path,
                                                                                 whom: str) -> None:
    supervisor = runner.pid
    victim = supervisor if whom == "supervisor" else submit(runner, jobs.loaded).result(120.0)[1]
    future = hanging(runner, jobs, tmp_path)
    os.kill(victim, signal.SIGKILL)
    with pytest.raises(JobFailed, match="hang: its process"):
        future.result(120.0)
    assert submit(runner, jobs.double, 1).result(60) == 2
    assert (runner.pid != supervisor) == (whom == "supervisor")


@pytest.mark.parametrize("whom", ["supervisor", "child"])
def test_killed_while_it_is_idle_it_is_replaced(runner: IsolatedRunner, jobs: ModuleType, whom: str) -> None:
    supervisor = runner.pid
    os.kill(supervisor if whom == "supervisor" else submit(runner, jobs.loaded).result(120.0)[1], signal.SIGKILL)
    assert submit(runner, jobs.double, 1).result(60) == 2


def test_an_answer_that_cannot_be_received_fails_and_the_next_job_is_done(runner: IsolatedRunner, jobs: ModuleType,
                                                                          monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(_: bytes) -> Any:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(isolated, "_decode_answer", no_memory)
        with pytest.raises(JobFailed, match="double: its answer cannot be received: MemoryError"):
            submit(runner, jobs.double, 1).result(120.0)
    assert submit(runner, jobs.double, 1).result(120.0) == 2


def test_closing_in_the_middle_of_a_job_leaves_no_process(runner: IsolatedRunner, jobs: ModuleType, tmp_path: Path) -> None:
    submit(runner, jobs.spawn).result(120.0)
    pid, running, waiting = runner.pid, hanging(runner, jobs, tmp_path), submit(runner, jobs.double, 1)
    runner.close()
    for future in (running, waiting, submit(runner, jobs.double, 1)):
        with pytest.raises(JobFailed):
            future.result(120.0)
    assert gone(pid)
    runner.close()


def test_what_cannot_be_loaded_is_told(jobs: ModuleType) -> None:
    runner = IsolatedRunner(jobs.cannot_load)
    try:
        with pytest.raises(JobFailed, match="RuntimeError: no such solver"):
            runner.wait_ready()
        with pytest.raises(JobFailed, match="RuntimeError: no such solver"):
            submit(runner, jobs.double, 1).result(60)
    finally:
        runner.close()


def test_jobs_of_a_process_that_the_system_refuses_to_start_fail_at_once(jobs: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    runner = IsolatedRunner(command=("/nonexistent",))
    try:
        for _ in range(2):
            with pytest.raises(JobFailed, match="did not start: .*No such file"):
                submit(runner, jobs.double, 1, limit=None).result(20.0)
        with pytest.raises(JobFailed, match="No such file"):
            runner.wait_ready()
        monkeypatch.setattr(runner, "_command", isolated.COMMAND)  # the system has recovered
        assert submit(runner, jobs.double, 21).result(120.0) == 42
    finally:
        runner.close()


def test_the_processes_end_with_a_caller_that_is_killed(jobs: ModuleType) -> None:
    caller = Path(str(jobs.__file__)).with_name("caller.py")
    caller.write_text("""
import os, signal, isolated_jobs
from perch_core.job import Job
from perch_core.isolated import IsolatedRunner
runner = IsolatedRunner()
runner.wait_ready()
future = runner.submit(Job(isolated_jobs.hang, (), print))
while not future.running():
    pass
print(runner.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
""")
    ended = subprocess.run([sys.executable, str(caller)], capture_output=True, text=True, check=False, timeout=120)
    assert gone(int(ended.stdout))


def test_ctrl_c_in_the_terminal_does_not_reach_the_processes(lasting: IsolatedRunner, jobs: ModuleType) -> None:
    assert os.getpgid(lasting.pid) == lasting.pid != os.getpgid(0)
    child = submit(lasting, jobs.loaded).result(120.0)[1]
    for pid in (lasting.pid, child):
        os.kill(pid, signal.SIGINT)
    assert submit(lasting, jobs.loaded).result(120.0)[1] == child
