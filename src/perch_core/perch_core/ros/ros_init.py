"""Initialisation of ROS in a process."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from perch_core.ros.shared_memory import remove_unfinished_segments

WITHOUT_LOG_FILES = ("--ros-args", "--disable-external-lib-logs")
"""Arguments with which ROS writes no log file, and does not need its log folder."""


def init_ros(args: Sequence[str] | None = None, context: Context | None = None) -> None:
    """Call `rclpy.init` without its signal handlers, after removing shared memory that a killed process left unfinished.

    ROS refuses to start where it cannot write its log folder (no HOME, as in a service of systemd; a read-only home). Then
    there is a warning, and no log file of ROS.

    Args:
        args: command line with the ROS arguments; None: this process's own.
        context: None: the default one.
    """
    remove_unfinished_segments()
    given = list(sys.argv if args is None else args)
    problem = _log_folder_problem()
    if problem and WITHOUT_LOG_FILES[1] not in given:
        print(f"warning: ROS writes no log files: {problem} (ROS_LOG_DIR sets another folder)", file=sys.stderr, flush=True)
        given += WITHOUT_LOG_FILES
    rclpy.init(args=given, context=context, signal_handler_options=SignalHandlerOptions.NO)


def _log_folder_problem() -> str:
    """Return why ROS cannot write the folder that it chooses for its logs, or nothing."""
    home = os.environ.get("HOME", "")
    chosen = os.environ.get("ROS_LOG_DIR") or os.path.join(os.environ.get("ROS_HOME") or os.path.join("~", ".ros"), "log")
    if chosen.startswith("~") and not home:
        return "HOME is not set"
    folder = Path(home + chosen[1:] if chosen.startswith("~") else chosen)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return f"{folder}: {error.strerror}"
