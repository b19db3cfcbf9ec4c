"""Imported first in a fork server: when its caller ends, in whatever way, the server is killed, and the forked nodes with it."""

from __future__ import annotations

import os
import signal

from perch_core.processes import end_with_parent

SERVER = os.getpid()  # of the fork server, also in the processes that it forks
end_with_parent(signal.SIGKILL)
