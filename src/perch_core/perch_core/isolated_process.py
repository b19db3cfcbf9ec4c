"""The processes of isolated jobs: a supervisor that keeps everything loaded, and a child that executes jobs and may be killed.

When the child does not answer in time, the supervisor kills it and forks a new one, which takes milliseconds; starting a
new Python with its libraries would take seconds. Started by `isolated.IsolatedRunner`, not by hand.
"""

from __future__ import annotations

import gc
import math
import os
import pickle
import resource
import select
import signal
import sys
from multiprocessing.connection import Connection, Pipe

from perch_core.errors import PerchError
from perch_core.isolated import _HEADER
from perch_core.processes import end_with_parent

OUT_OF_MEMORY = 42
"""Exit status of a child that ran out of memory. It is replaced, as too little may be left for the next job."""


def _answer(payload: bytes) -> bytes:
    """Execute a job; return the answer in the format of `isolated._decode_answer`.

    Raises:
        MemoryError: the process is out of memory, whatever the job has made of that.
    """
    try:
        function, arguments = pickle.loads(payload)
        result = function(*arguments)
    except (Exception, SystemExit) as error:  # the caller must get an answer whatever happens here
        if _out_of_memory(error):
            raise MemoryError from error
        if isinstance(error, PerchError):
            return b"E" + pickle.dumps(error)
        return b"F" + f"{type(error).__name__}: {error}".encode(errors="replace")
    try:
        return b"A" + pickle.dumps(result)
    except MemoryError:
        raise
    except Exception as error:  # what pickle raises depends on what it is given
        return b"F" + f"what it returned cannot be sent: {error}".encode(errors="replace")


def _out_of_memory(error: BaseException | None) -> bool:
    """Return whether an exception, or one that led to it, is of a failed allocation; CasADi's is a RuntimeError."""
    while error is not None and not isinstance(error, MemoryError) and "std::bad_alloc" not in str(error):
        error = error.__cause__ or error.__context__
    return error is not None


def _child(pipe: Connection, supervisor: int, memory: int) -> None:
    """Execute jobs until the pipe closes."""
    end_with_parent(signal.SIGKILL, supervisor)
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        try:
            pipe.send_bytes(_answer(pipe.recv_bytes()))
        except (EOFError, OSError):
            os._exit(0)
        except MemoryError:
            os._exit(OUT_OF_MEMORY)


def _fork(upstream: Connection, memory: int) -> tuple[int, Connection]:
    parent_end, child_end = Pipe()
    supervisor, pid = os.getpid(), os.fork()
    if pid == 0:
        parent_end.close()
        upstream.close()
        _child(child_end, supervisor, memory)
    child_end.close()
    return pid, parent_end


def _exit_reason(status: int, memory: int) -> str:
    """Return why a child has ended, as text."""
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        return f"its process crashed ({name}); the limit of its memory is {memory / 2**30:.3g} GiB"
    if os.WEXITSTATUS(status) == OUT_OF_MEMORY:
        return f"out of memory: the limit of its process is {memory / 2**30:.3g} GiB"
    return f"its process ended itself (exit status {os.WEXITSTATUS(status)})"


def supervise(upstream: Connection) -> None:
    """Serve a pipe until it closes: receive `sys.path` and the memory of the child [byte], then the preload, then jobs for the child."""
    sys.path[:], memory = upstream.recv()
    try:
        preload = pickle.loads(upstream.recv_bytes())
        if preload is not None:
            preload()
    except Exception as error:  # reported to the caller, who raises it
        upstream.send_bytes(f"{type(error).__name__}: {error}".encode())
        return
    gc.collect()
    gc.freeze()  # what is loaded stays shared with the children
    pid, child = _fork(upstream, memory)
    upstream.send_bytes(b"ready")
    while True:
        try:
            job = upstream.recv_bytes()
        except EOFError:
            os.kill(pid, signal.SIGKILL)
            return
        answer = None
        while answer is None:
            answer, ended = _run(job, child, upstream, pid, memory)
            if ended:
                child.close()
                if upstream.closed:
                    return
                pid, child = _fork(upstream, memory)
        upstream.send_bytes(answer)


def _run(job: bytes, child: Connection, upstream: Connection, pid: int, memory: int) -> tuple[bytes | None, bool]:
    """Have a child execute a job.

    Returns:
        The answer, None if the child ended before it took the job; and whether the child has ended. If the caller has
        ended, `upstream` is closed.
    """
    limit, = _HEADER.unpack_from(job)
    try:
        child.send_bytes(job[_HEADER.size:])
        ready, _, _ = select.select([child, upstream], [], [], None if limit == math.inf else limit)
        if child in ready:
            return child.recv_bytes(), False
    except EOFError:
        return b"F" + _exit_reason(os.waitpid(pid, 0)[1], memory).encode(), True
    except OSError:  # it was ended from outside between two jobs
        os.waitpid(pid, 0)
        return None, True
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    if upstream in ready:
        upstream.close()
    return b"T", True


def main() -> None:
    """Serve a pipe; the last two arguments of the command line are its file descriptor and the caller's process id."""
    end_with_parent(signal.SIGKILL, int(sys.argv[-1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller decides when this ends
    supervise(Connection(int(sys.argv[-2])))


if __name__ == "__main__":
    main()
