"""What all tests share: compiled Python, checked message fields, reproducible examples, ROS domains of their own, and which of them are quick."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

UNIT = Path(__file__).parent / "unit"

# The tests start some hundred Python processes. Where nobody keeps what Python compiles (PYTHONDONTWRITEBYTECODE; pip with --no-compile),
# each of them would compile a thousand files again, three seconds of processor time: it is kept here, outside the sources.
sys.pycache_prefix = os.environ.setdefault("PYTHONPYCACHEPREFIX", str(UNIT.parents[1] / ".perch" / "pycache"))
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Before the first message class is imported: by default a wrong type becomes silent garbage on the wire.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")

# Started in the background of a shell, this process and all that it starts would ignore Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No luck and no stop-watch: the same examples in each run, on slow machines too.
settings.register_profile(
    "perch", deadline=None, derandomize=True, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("perch")

TAKES_TIME = re.compile(
    r"^\s*(?:from|import) (?:closed_loop|open_loop(?:\.| import )flight|oracles|"
    r"perch_eval(?:\.| import )(?:control_flights|in_process|program|ros|scripted_flight|stack)|"
    r"perch_core\.isolated|perch_sim\.(?:rendering|simulation)|psutil|rclpy|subprocess|system)\b", re.MULTILINE)
"""Imports of test files that fly, draw or start something."""


@cache
def takes_time(file: Path) -> bool:
    """Whether a test file flies, draws or starts something."""
    return TAKES_TIME.search(file.read_text()) is not None


def is_quick(file: Path) -> bool:
    """Whether a test file may have quick tests."""
    return file.parent == UNIT and not takes_time(file)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """`-m quick` imports no file that has no quick test."""
    return True if config.option.markexpr == "quick" and collection_path.match("test_*.py") and not is_quick(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """`quick` are unit tests of files that neither fly, draw nor start anything, but those that are marked `slow`.

    A test for each of no files or rows at all, which pytest would skip, is an error: what it looked for has moved.
    """
    empty = [item.nodeid for item in items for mark in item.iter_markers("skip") if "empty parameter set" in str(mark.kwargs.get("reason"))]
    if empty:
        raise pytest.UsageError(f"no parameters: {', '.join(empty)}")
    for item in items:
        if is_quick(item.path) and item.get_closest_marker("slow") is None:
            item.add_marker("quick")


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that nobody else on this machine uses; `ROS_DOMAIN_ID` is set to it."""
    from perch_eval.domain import reserved_domain

    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages and pictures are made without drawing their figures, each of which takes a third of a second."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)
    monkeypatch.setattr("matplotlib.backends.backend_agg.FigureCanvasAgg.print_png", lambda *_, **__: None)


@pytest.fixture
def executor(ros_domain):
    """Of the nodes of a test, in a domain of their own; they are closed after it."""
    import rclpy
    from perch_core.ros.node import close_nodes
    from rclpy.executors import SingleThreadedExecutor

    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    yield executor
    close_nodes(executor.get_nodes())
    rclpy.shutdown(context=context)
