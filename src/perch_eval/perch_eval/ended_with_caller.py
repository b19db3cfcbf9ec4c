"""Imported in a fork server before all else: it ends when its caller ends, however that happens, and what it has forked ends with it."""

from __future__ import annotations

import signal

from perch_core.processes import end_with_parent

end_with_parent(signal.SIGKILL)
