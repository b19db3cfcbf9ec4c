"""Ctrl-C while a program comes up. Loads nothing itself: whatever loads before it is interrupted with a traceback."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

INTERRUPTED = 130  # exit code


@contextmanager
def quiet_on_interrupt() -> Iterator[None]:
    """Around imports, which take seconds: Ctrl-C ends the process without a traceback, unless somebody has a use of their own for it.

    A Ctrl-C that `scripts/run_node.py` held back while Python started counts here.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
