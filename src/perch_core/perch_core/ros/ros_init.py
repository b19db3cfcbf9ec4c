"""Initialisation of ROS in a process."""

from __future__ import annotations

from collections.abc import Sequence

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from perch_core.ros.shared_memory import remove_unfinished_segments


def init_ros(args: Sequence[str] | None = None, context: Context | None = None) -> None:
    """Call `rclpy.init` without its signal handlers, after removing shared memory that a killed process left unfinished.

    Args:
        args: command line with the ROS arguments; None: this process's own.
        context: None: the default one.
    """
    remove_unfinished_segments()
    rclpy.init(args=None if args is None else list(args), context=context, signal_handler_options=SignalHandlerOptions.NO)
