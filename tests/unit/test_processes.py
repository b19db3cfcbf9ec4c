"""Signals of processes: a limit for their end, and Ctrl-C that is not theirs."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest


def _run(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)


def test_a_process_that_does_not_end_is_ended():
    assert _run("from perch_core.processes import end_within\nend_within(1)\nwhile True: pass").returncode == -signal.SIGALRM


@pytest.mark.parametrize("parent, code", [("os.getppid()", 5), ("os.getppid() + 1", -signal.SIGTERM), ("None", 5)])
def test_a_process_whose_parent_has_already_ended_ends_at_once(parent, code):
    script = f"import os, signal, sys\nfrom perch_core.processes import end_with_parent\nend_with_parent(signal.SIGTERM, {parent})\nsys.exit(5)"
    assert _run(script).returncode == code


def test_what_is_started_without_interrupts_does_not_see_them():
    """It is sent one while it starts; the caller sees its own again afterwards."""
    done = _run("""
import os, signal, subprocess, sys
from perch_core.processes import without_interrupts
with without_interrupts():
    child = subprocess.Popen([sys.executable, "-c", "print('alive')"], stdout=subprocess.PIPE, text=True)
    os.kill(child.pid, signal.SIGINT)
assert child.communicate()[0].strip() == "alive" and child.returncode == 0
try:
    os.kill(os.getpid(), signal.SIGINT)
except KeyboardInterrupt:
    print("interrupted")
""")
    assert done.stdout.strip() == "interrupted", done.stderr
