"""Cheap engines for tests of campaigns; workers import this file by name."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

from perch_eval.campaign.results import RunResult


def quick(task) -> RunResult:
    """A flight in 10 ms that succeeds in light wind."""
    time.sleep(0.01)
    gust = task.run.values.get("wind.gust_sigma", 0.0)
    cause = "perched" if gust < 0.5 else "tilt" if task.run.seed % 3 else "missed_pad"
    return RunResult(task.run.number, task.run.seed, cause, "perched" if cause == "perched" else "missed", "as the wind was",
                     metrics={"contact_tilt_error_deg": 20.0 * gust})


def held(task) -> RunResult:
    """As `quick`; from run 100 on they wait until they may, and the worker that then flies run 150 for the first time is killed."""
    marker = Path(os.environ["PERCH_TEST_MARKER"])
    while task.run.number >= 100 and not marker.exists():
        time.sleep(0.01)
    if task.run.number == 150:
        die_once(marker.with_name("killed in run 150"))
    return quick(task)


def mortal(task) -> RunResult:
    """The worker that flies run 11 for the first time is killed in mid-run; the others say on how many threads BLAS adds there."""
    if task.run.number == 11:
        die_once(Path(os.environ["PERCH_TEST_MARKER"]))
    return replace(quick(task), message=str(threads()))


def die_once(marker: Path) -> None:
    """Kill this process, if none has been killed yet."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)


def broken(task) -> RunResult:
    """One run in four cannot be carried out."""
    if task.run.number % 4 == 0:
        raise RuntimeError("the simulator is out of fuel")
    return quick(task)


def threads() -> int:
    """On how many threads BLAS adds in this process."""
    with open("/proc/self/maps") as file:
        path = next(line.split()[-1] for line in file if "openblas" in line and "numpy" in line)
    library = ctypes.CDLL(path)
    name = next(name for name in ("scipy_openblas_get_num_threads64_", "openblas_get_num_threads64_", "openblas_get_num_threads") if hasattr(library, name))
    return getattr(library, name)()
