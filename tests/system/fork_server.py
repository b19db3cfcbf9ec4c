"""Runs Python scripts, each in a process that is forked from this one, which has made their imports.

    fork_server.py SOCKET MODULE ...

SOCKET is the number of a file that stays open. Each request is JSON `[[script, arguments...], environment]` with four files: its
standard input, output and error, and one that receives `pid` and, when the script has ended, `code`, a line each. All ends with SOCKET.
"""

from __future__ import annotations

import gc
import importlib
import inspect
import json
import os
import runpy
import select
import signal
import socket
import sys

from perch_core.processes import end_with_parent


def serve(requests: socket.socket) -> tuple[list[str], dict[str, str], list[int]]:
    """Fork for each request; returns in each of these processes, with what it is to be."""
    woken, wake = os.pipe()
    os.set_blocking(woken, False), os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # which a terminal sends to all
    answers: dict[int, int] = {}
    while True:
        ready, _, _ = select.select([requests, woken], [], [])
        if woken in ready:
            os.read(woken, 4096)
            for pid in list(answers):
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    tell(answers[pid], os.waitstatus_to_exitcode(status))
                    os.close(answers.pop(pid))
        if requests in ready:
            message, files, _, _ = socket.recv_fds(requests, 1 << 20, 4)
            if not message:
                for pid in answers:
                    os.kill(pid, signal.SIGKILL)
                sys.exit(0)
            pid = os.fork()
            if pid == 0:
                signal.set_wakeup_fd(-1)
                for file in (requests.detach(), woken, wake, *answers.values(), files[3]):
                    os.close(file)
                return *json.loads(message), files[:3]
            os.setpgid(pid, pid)  # before anybody knows of it: a group of its own, as where it is started alone
            for file in files[:3]:
                os.close(file)
            answers[pid] = files[3]
            tell(files[3], pid)


def tell(file: int, number: int) -> None:
    """One line; whoever does not listen any more is not told."""
    try:
        os.write(file, f"{number}\n".encode())
    except BrokenPipeError:
        pass


def become(arguments: list[str], environment: dict[str, str], files: list[int]) -> None:
    """Be the script's process."""
    end_with_parent(signal.SIGKILL)
    for number in (signal.SIGCHLD, signal.SIGPIPE):
        signal.signal(number, signal.SIG_DFL if number == signal.SIGCHLD else signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for target, source in enumerate(files):
        os.dup2(source, target)
        os.close(source)
    os.environ.clear()
    os.environ.update(environment, PERCH_ENTERED=str(os.getpid()))  # a script finds itself in the environment that it would enter
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    sys.argv = arguments
    sys.path[0] = os.path.dirname(os.path.realpath(arguments[0]))


if __name__ == "__main__":
    for name in sys.argv[2:]:
        importlib.import_module(name)
    inspect.getmodule(inspect.currentframe())  # finds the files of all modules, once for all: the first line of a log asks for them
    gc.collect(), gc.freeze()  # what is not looked through is not copied
    one = serve(socket.socket(fileno=int(sys.argv[1])))
    become(*one)
    runpy.run_path(sys.argv[0], run_name="__main__")
