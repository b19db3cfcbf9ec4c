"""Imported first in a fork server: when its caller ends, in whatever way, the server is killed, and the forked nodes with it."""

from __future__ import annotations

import signal

from perch_core.processes import end_with_parent

end_with_parent(signal.SIGKILL)
