"""A forked script is a process as a started one is: exit code, output, environment, signals, group and end; what `system.forks` promises to the other tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time

import psutil
import pytest
from system import forks

MODULES = ("json",)
SCRIPTS = {
    "it is through": "print(__name__)", "it says why not": "import sys; print('so far'); sys.exit('why')", "it counts": "raise SystemExit(3)",
    "it has a defect": "import os\nos.no_such_thing", "it is killed": "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
    "it ends on SIGINT": "import os, signal; os.kill(os.getpid(), signal.SIGINT)", "it leaves": "import os; print('x', flush=True); os._exit(4)",
    "it knows its name": "import sys; print(sys.argv)", "it knows its world": "import os; print(os.environ['PERCH_WORD'])",
    "it imports what is beside it": "import beside; print(beside.WORD)", "it cleans up": "import atexit; atexit.register(print, 'clean')",
}


@pytest.mark.parametrize("program", SCRIPTS.values(), ids=SCRIPTS)
def test_it_is_as_if_it_were_started(program, tmp_path):
    script, environment = tmp_path / "script.py", {**os.environ, "PERCH_WORD": "heard"}
    script.write_text(program)
    (tmp_path / "beside.py").write_text("WORD = 'found'\n")
    forked = forks.run(MODULES, [str(script), "one", "--two"], 60.0, environment)
    started = subprocess.run([sys.executable, str(script), "one", "--two"], env=environment, capture_output=True, text=True)
    assert (forked.returncode, forked.stdout) == (started.returncode, started.stdout)
    assert forked.stderr.splitlines()[-1:] == started.stderr.splitlines()[-1:]  # before, a traceback names those who run it, too


def test_it_is_alone_in_its_group_and_can_be_stopped_and_ended(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import time\nwhile True:\n    time.sleep(0.01)\n")
    with tempfile.TemporaryFile("w+") as output:
        ones = [forks.Forked(MODULES, [str(script)], output, output) for _ in range(2)]
        assert [os.getpgid(one.pid) for one in ones] == [one.pid for one in ones]
        with pytest.raises(subprocess.TimeoutExpired):
            ones[0].wait(0.05)
        ones[0].terminate(), ones[1].send_signal(signal.SIGSTOP)
        assert ones[0].wait(60.0) == -signal.SIGTERM and ones[1].poll() is None
        ones[1].kill()
        assert ones[1].wait(60.0) == ones[1].poll() == -signal.SIGKILL


def works(pid: int) -> bool:
    """Whether a process has not ended; one that only nobody has asked about yet (a zombie) has."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_all_end_with_whoever_has_started_them(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import time\ntime.sleep(600)\n")
    caller = ("import os, sys; from system import forks; one = forks.Forked(('json',), [sys.argv[1]], sys.stderr, sys.stderr); "
              "print(one.pid, flush=True); os.kill(os.getpid(), 9)")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", caller, str(script)], env=environment, stdout=subprocess.PIPE, text=True)
    pid, end = int(done.stdout), time.monotonic() + 60.0
    while works(pid):
        assert time.monotonic() < end
        time.sleep(0.01)
