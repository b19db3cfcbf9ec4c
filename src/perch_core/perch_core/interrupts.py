"""Handling of Ctrl-C during start-up. Imports little itself, because an interrupt before its use shows a traceback."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

INTERRUPTED = 130  # exit code


@contextmanager
def quiet_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process without a traceback during imports, which take seconds; another handler of SIGINT is kept.

    A Ctrl-C that `scripts/run_node.py` blocked while Python started takes effect here. SIGINT is unblocked in any case: where
    it is ignored, as in a shell's background jobs, it is so until the node sets its own handler, as rclpy does.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.getsignal(signal.SIGINT)
    if handler is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if handler is signal.default_int_handler:
            signal.signal(signal.SIGINT, handler)
