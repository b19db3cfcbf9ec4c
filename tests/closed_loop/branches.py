"""Ways that part from one state: each is gone in a process of its own, forked where they part, so that the way there is gone once."""

from __future__ import annotations

import gc
import os
import pickle
import traceback
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")


def branched(way: Callable[[], Found]) -> Found:
    """What a way comes to; nothing of it is left in this process.

    Raises:
        AssertionError: with the traceback of what it raised, or without where its process died.
    """
    reads, writes = os.pipe()
    pid = os.fork()
    if pid == 0:
        gc.freeze()  # garbage of this process may belong to threads that are not there in the child: collecting it there crashes
        with os.fdopen(writes, "wb") as out:
            try:
                answer: tuple[bool, object] = (True, way())
            except BaseException:
                answer = (False, traceback.format_exc())
            pickle.dump(answer, out)
        os._exit(0)
    os.close(writes)
    with os.fdopen(reads, "rb") as answers:
        data = answers.read()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    assert data and code == 0, f"its process ended with {code}"
    good, found = pickle.loads(data)
    assert good, found
    return found
