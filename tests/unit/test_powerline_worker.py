"""The planning process: answers, typed refusals in time from a solver that hangs, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from perch_core.errors import PerchError, PlanningRefusal
from perch_core.vehicle import load_vehicle
from perch_planner.powerline import problem
from perch_planner.powerline.worker import PowerlineWorker

VEHICLE = load_vehicle("rpg")
REQUEST = problem.load("powerline_line_20").request(VEHICLE)

HANGING = """
import time
from types import SimpleNamespace
from perch_planner.powerline import solver_process

class Hanging:
    def __init__(self, *_):
        pass
    def warm_up(self):
        pass
    def plan(self, request):
        if request.solver != {answers!r}:
            while True:
                time.sleep(1)
        return SimpleNamespace(solver=request.solver)

solver_process.main(Hanging)
"""


def hanging(folder: Path, answers: str) -> PowerlineWorker:
    """A worker whose planner hangs for every solver but one."""
    script = folder / "hanging.py"
    script.write_text(HANGING.format(answers=answers))
    return PowerlineWorker(VEHICLE, command=(sys.executable, str(script)))


def alive(pid: int) -> bool:
    try:
        os.killpg(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[PowerlineWorker]:
    made = hanging(tmp_path, "nothing")
    yield made
    made.close()


def test_a_hanging_solver_is_stopped_and_the_next_request_is_served_again(worker: PowerlineWorker) -> None:
    worker.wait_ready()
    for _ in range(2):
        with pytest.raises(PlanningRefusal) as refusal:
            worker.plan(REQUEST, deadline=0.4)
        assert refusal.value.code == "deadline"
        assert "0.4 s" in str(refusal.value)


def test_the_fallback_solver_gets_the_rest_of_the_deadline(tmp_path: Path) -> None:
    worker = hanging(tmp_path, "ipopt")
    try:
        worker.wait_ready()
        assert worker.plan(REQUEST, deadline=2.0).solver == "ipopt"
    finally:
        worker.close()


def test_closing_leaves_no_process(worker: PowerlineWorker) -> None:
    worker.wait_ready()
    pid = worker.pid
    worker.close()
    for _ in range(200):
        if not alive(pid):
            return
        time.sleep(0.05)
    pytest.fail("the planning processes are still there")


def test_a_supervisor_that_was_killed_is_replaced(worker: PowerlineWorker) -> None:
    worker.wait_ready()
    os.killpg(worker.pid, signal.SIGKILL)
    killed = worker.pid
    with pytest.raises(PlanningRefusal):  # it may find the pipe broken, or the new process not ready
        worker.plan(REQUEST, deadline=0.2)
    with pytest.raises(PlanningRefusal):
        worker.plan(REQUEST, deadline=0.2)
    assert worker.wait_ready() and worker.pid != killed
    with pytest.raises(PlanningRefusal, match="no plan within 0.4 s"):
        worker.plan(REQUEST, deadline=0.4)


def test_a_planner_that_cannot_start_says_why(tmp_path: Path) -> None:
    script = tmp_path / "broken.py"
    script.write_text("from perch_planner.powerline import solver_process\n"
                      "def make(*_):\n    raise RuntimeError('no such solver')\nsolver_process.main(make)\n")
    worker = PowerlineWorker(VEHICLE, command=(sys.executable, str(script)))
    try:
        with pytest.raises(PerchError, match="no such solver"):
            worker.wait_ready()
    finally:
        worker.close()


@pytest.mark.parametrize("deadline", [0.0, -1.0])
def test_a_deadline_that_is_none_is_refused(worker: PowerlineWorker, deadline: float) -> None:
    with pytest.raises(PlanningRefusal, match="deadline"):
        worker.plan(REQUEST, deadline=deadline)


def test_the_planning_processes_end_with_a_caller_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "hanging.py"
    script.write_text(HANGING.format(answers="nothing"))
    caller = tmp_path / "caller.py"
    caller.write_text(f"""
import os, signal, sys
from perch_core.vehicle import load_vehicle
from perch_planner.powerline.worker import PowerlineWorker
if __name__ == "__main__":
    worker = PowerlineWorker(load_vehicle("rpg"), command=(sys.executable, {str(script)!r}))
    worker.wait_ready()
    print(worker.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
""")
    pid = int(subprocess.run([sys.executable, str(caller)], capture_output=True, text=True, check=False, timeout=120).stdout)
    for _ in range(400):
        if not alive(pid):
            return
        time.sleep(0.05)
    pytest.fail("the planning processes outlived their caller")
