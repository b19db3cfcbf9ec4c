"""Real-time scheduling: what is raised, and what is said where it is not allowed."""

import os
import subprocess
import sys

from perch_core.ros.priority import Priority

ASK = """
import _thread, os, queue, threading
from pathlib import Path
from perch_core.ros.priority import Priority
release, begun = threading.Event(), queue.SimpleQueue()
drawing = threading.Thread(target=release.wait); drawing.start()
def of_the_middleware(name):
    Path(f"/proc/self/task/{_thread.get_native_id()}/comm").write_text(name)
    begun.put(_thread.get_native_id())
    release.wait()
def started(name):
    _thread.start_new_thread(of_the_middleware, (name,))
    return begun.get()
receives, sends_large = started("dds.udp.7412"), started("dds.asyn.0.0")
own = Priority(); own.nodes = 1
problem = own.raise_priority()
later = threading.Thread(target=release.wait); later.start()
policies = {name: os.sched_getscheduler(task) & ~os.SCHED_RESET_ON_FORK for name, task in (
    ("loop", os.getpid()), ("receives", receives), ("drawing", drawing.native_id), ("later", later.native_id), ("sends large", sends_large))}
release.set()
raised = {name for name, policy in policies.items() if policy == os.SCHED_FIFO}
assert raised == (set() if problem else {"loop", "receives"}), policies
assert problem == "" or "no permission" in problem, problem
"""


def test_the_loop_and_the_middleware_are_raised_but_not_python_s_threads_nor_what_spins():
    """Where it is not allowed nothing changes and the reason is told."""
    subprocess.run([sys.executable, "-c", ASK], check=True, timeout=120)


def test_a_process_with_other_work_is_left_alone():
    before = os.sched_getscheduler(0)
    assert Priority().raise_priority() == ""
    assert os.sched_getscheduler(0) == before != os.SCHED_FIFO


GIVE_WAY = """
import os
from perch_core.ros.priority import NICE, Priority
nice = lambda task: os.getpriority(os.PRIO_PROCESS, task)
before = nice(os.getpid())
Priority().lower_priority()
assert nice(os.getpid()) == before, 'a process with other work is left alone'
composed = Priority(); composed.nodes = 3
composed.lower_priority()
assert nice(os.getpid()) == before, 'neighbours may be in a hurry'
own = Priority(); own.nodes = 1
own.lower_priority()
assert nice(os.getpid()) == NICE
assert os.sched_getscheduler(0) == os.SCHED_BATCH, 'it interrupts nobody'
"""


def test_work_that_has_time_gives_way():
    subprocess.run([sys.executable, "-c", GIVE_WAY], check=True, timeout=120)
