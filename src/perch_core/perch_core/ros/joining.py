"""How a process of ours joins the ROS graph."""

from __future__ import annotations

from collections.abc import Sequence

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from perch_core.ros.shared_memory import end_unfinished


def join(args: Sequence[str] | None = None, context: Context | None = None) -> None:
    """`rclpy.init`, where signals stay the caller's, and a process that was killed while it joined holds nobody up.

    Args:
        args: command line with the ROS arguments; None: this process's own.
        context: None: the default one.
    """
    end_unfinished()
    rclpy.init(args=None if args is None else list(args), context=context, signal_handler_options=SignalHandlerOptions.NO)
