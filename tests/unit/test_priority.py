"""Real-time scheduling: what is raised, and what is said where it is not allowed."""

import os
import subprocess
import sys

from perch_core.ros.priority import Priority

ASK = """
import os, threading
from perch_core.ros.priority import Priority
release = threading.Event()
drawing = threading.Thread(target=release.wait); drawing.start()
own = Priority(); own.nodes = 1
problem = own.ask()
later = threading.Thread(target=release.wait); later.start()
policy = [os.sched_getscheduler(t) & ~os.SCHED_RESET_ON_FORK for t in (os.getpid(), drawing.native_id, later.native_id)]
release.set()
assert policy == ([os.SCHED_OTHER] * 3 if problem else [os.SCHED_FIFO, os.SCHED_OTHER, os.SCHED_OTHER]), policy
assert problem == "" or "no permission" in problem, problem
"""


def test_the_loop_is_raised_and_python_threads_are_not():
    """Where it is not allowed nothing changes and the reason is told."""
    subprocess.run([sys.executable, "-c", ASK], check=True, timeout=120)


def test_a_process_with_other_work_is_left_alone():
    assert Priority().ask() == ""
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


GIVE_WAY = """
import os
from perch_core.ros.priority import NICE, Priority
nice = lambda task: os.getpriority(os.PRIO_PROCESS, task)
before = nice(os.getpid())
Priority().give_way()
assert nice(os.getpid()) == before, 'a process with other work is left alone'
composed = Priority(); composed.nodes = 3
composed.give_way()
assert nice(os.getpid()) == before, 'neighbours may be in a hurry'
own = Priority(); own.nodes = 1
own.give_way()
assert nice(os.getpid()) == NICE
assert os.sched_getscheduler(0) == os.SCHED_BATCH, 'it interrupts nobody'
"""


def test_work_that_has_time_gives_way():
    subprocess.run([sys.executable, "-c", GIVE_WAY], check=True, timeout=120)
