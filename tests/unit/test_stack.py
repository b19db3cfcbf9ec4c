"""Stack: programs are started together, watched, and never left running."""

from __future__ import annotations

import os
import queue
import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest
from perch_eval import stack as stack_module
from perch_eval.program import Program
from perch_eval.stack import Stack, StackError

PATIENCE = 60.0  # only ever waited for in full when a test fails

OBEDIENT = "import signal, sys; signal.signal(signal.SIGINT, lambda *_: sys.exit(0))"
ONLY_TERM = "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); signal.signal(signal.SIGTERM, lambda *_: sys.exit(5))"
STUBBORN = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); signal.signal(signal.SIGTERM, signal.SIG_IGN)"
WAIT = "print('up', flush=True)\nwhile True: signal.pause()"


def python(name: str, *lines: str, nodes: tuple[str, ...] = ()) -> Program:
    """A program that runs some lines of Python."""
    return Program(name, (sys.executable, "-S", "-c", "\n".join(lines)), nodes)


class Lines:
    """Output of a stack, to wait for."""

    def __init__(self) -> None:
        self._queue: queue.Queue[tuple[str, str]] = queue.Queue()

    def __call__(self, name: str, line: str) -> None:
        self._queue.put((name, line))

    def wait_for(self, *wanted: tuple[str, str]) -> None:
        """Wait until every (name, line) has come, in any order."""
        left = set(wanted)
        while left:
            left.discard(self._queue.get(timeout=PATIENCE))


def wait_until(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


@pytest.mark.parametrize("manners, code", [(OBEDIENT, 0), (ONLY_TERM, 5), (STUBBORN, -signal.SIGKILL)])
def test_each_program_gets_the_mildest_signal_that_ends_it(tmp_path, monkeypatch, manners, code):
    in_vain = {OBEDIENT: 0, ONLY_TERM: 1, STUBBORN: 2}[manners]  # signals; what ends it may take its time on a busy machine
    monkeypatch.setattr(stack_module, "_ESCALATION", tuple(
        (number, 0.1 if k < in_vain else PATIENCE) for k, (number, _) in enumerate(stack_module._ESCALATION)))
    lines = Lines()
    stack = Stack([python("it", manners, WAIT)], tmp_path, on_line=lines)
    stack.start()
    stack.wait_until_ready(set)
    lines.wait_for(("it", "up"))
    endings = stack.stop()
    assert endings["it"].code == code and stack.pids == {}
    assert stack.stop() == endings  # harmless


def test_everything_is_stopped_when_the_caller_fails(tmp_path):
    lines = Lines()
    with pytest.raises(ZeroDivisionError), Stack(
            [python("a", OBEDIENT, WAIT), python("b", OBEDIENT, WAIT)], tmp_path, on_line=lines) as stack:
        lines.wait_for(("a", "up"), ("b", "up"))
        pids = stack.pids.values()
        1 / 0
    assert len(pids) == 2 and not any(psutil.pid_exists(pid) for pid in pids)


def test_a_program_s_own_children_are_stopped_with_it(tmp_path):
    lines = Lines()
    child = f"{STUBBORN}\n{WAIT}"
    code = f"import subprocess, sys, time\np = subprocess.Popen([sys.executable, '-S', '-c', {child!r}])\nprint('child', p.pid, flush=True)\ntime.sleep(1000)"
    seen: list[str] = []

    def keep(name: str, line: str) -> None:
        seen.append(line)
        lines(name, line)

    with Stack([python("parent", code)], tmp_path, on_line=keep):
        lines.wait_for(("parent", "up"))
        wait_until(lambda: any(line.startswith("child") for line in seen))
    pid = int(next(line for line in seen if line.startswith("child")).split()[1])
    wait_until(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)


def test_a_program_that_ends_is_named_with_reason_and_last_lines(tmp_path):
    with Stack([python("fine", OBEDIENT, WAIT), python("bad", "print('last words')", "raise SystemExit(3)")], tmp_path) as stack:
        endings = stack.wait()
        assert [(e.name, e.code) for e in endings] == [("bad", 3)]
        text = str(endings[0])
        assert "bad ended: exit code 3" in text and "last words" in text and str(tmp_path / "bad.log") in text
        with pytest.raises(StackError, match="bad ended"):
            stack.raise_if_ended()
    assert (tmp_path / "bad.log").read_text() == "last words\n"


def test_a_full_disk_ends_no_program(tmp_path):
    (tmp_path / "talker.log").symlink_to("/dev/full")
    with Stack([python("talker", "for k in range(20_000): print('line', k, flush=True)")], tmp_path) as stack:
        ending, = stack.wait()
    assert ending.code == 0 and ending.tail[-1] == "line 19999"


def test_a_killed_program_is_named_with_the_signal(tmp_path):
    lines = Lines()
    with Stack([python("victim", OBEDIENT, WAIT)], tmp_path, on_line=lines) as stack:
        lines.wait_for(("victim", "up"))
        os.kill(stack.pids["victim"], signal.SIGKILL)
        assert "victim ended: killed by SIGKILL" in str(stack.wait()[0])


def test_exit_code_2_is_invalid_input(tmp_path):
    with Stack([python("node", "raise SystemExit(2)", nodes=("/node",))], tmp_path) as stack:
        with pytest.raises(StackError) as error:
            stack.wait_until_ready(set, timeout=PATIENCE)
    assert error.value.refused_input
    assert not StackError("other").refused_input


def test_an_executable_that_does_not_exist_is_named_and_nothing_stays(tmp_path):
    lines = Lines()
    stack = Stack([python("fine", OBEDIENT, WAIT), Program("ghost", ("/no/such/file",))], tmp_path, on_line=lines)
    with pytest.raises(StackError, match="ghost cannot be started: there is no executable /no/such/file"), stack:
        pass
    assert stack.pids == {}


def test_ready_once_all_nodes_are_visible(tmp_path):
    answers = iter([set(), {"/a"}, {"/a", "/other"}, {"/a", "/b", "/other"}])
    programs = [python("a", OBEDIENT, WAIT, nodes=("/a",)), python("b", OBEDIENT, WAIT, nodes=("/b",))]
    lines = Lines()
    with Stack(programs, tmp_path, on_line=lines) as stack:
        lines.wait_for(("a", "up"), ("b", "up"))
        stack.wait_until_ready(lambda: next(answers), timeout=PATIENCE)
    assert next(answers, None) is None


def test_nodes_that_do_not_appear_are_named(tmp_path):
    with Stack([python("a", OBEDIENT, WAIT, nodes=("/a", "/b"))], tmp_path) as stack:
        with pytest.raises(StackError, match="not ready after 0.1 s: /b"):
            stack.wait_until_ready(lambda: {"/a"}, timeout=0.1)


def test_what_is_not_ready_yet_is_stopped_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(stack_module, "_ESCALATION", ((signal.SIGINT, 1000.0),))
    lines = Lines()
    stack = Stack([python("loading", STUBBORN, WAIT, nodes=("/loading",))], tmp_path, on_line=lines)
    stack.start()
    lines.wait_for(("loading", "up"))
    assert stack.stop()["loading"].code == -signal.SIGKILL


def test_a_second_interrupt_does_not_stop_the_stopping(tmp_path):
    lines = Lines()
    stack = Stack([python("it", f"import os; signal_parent = {os.getpid()}", "import signal, sys",
                          "def leave(*_): os.kill(signal_parent, signal.SIGINT); sys.exit(0)", "signal.signal(signal.SIGINT, leave)", WAIT)],
                  tmp_path, on_line=lines)
    stack.start()
    stack.wait_until_ready(set)
    lines.wait_for(("it", "up"))
    assert stack.stop()["it"].code == 0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="util-linux without setpriv")
def test_programs_die_with_a_killed_parent(tmp_path):
    code = f"""
import sys, threading, time
from pathlib import Path
from perch_eval.program import Program
from perch_eval.stack import Stack
up = threading.Event()
stack = Stack([Program("a", (sys.executable, "-S", "-c", "import time; print('up', flush=True); time.sleep(1000)"))],
              Path({str(tmp_path)!r}), on_line=lambda name, line: up.set())
stack.start()
up.wait()
print(stack.pids['a'], flush=True)
time.sleep(1000)
"""
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    assert psutil.pid_exists(child)
    parent.kill()
    parent.wait()
    wait_until(lambda: not psutil.pid_exists(child) or psutil.Process(child).status() == psutil.STATUS_ZOMBIE)
