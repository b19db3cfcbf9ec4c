"""Action server whose goals are finished by the component."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from perch_core.ros.late_service import QUEUE_SIZE
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile


class GoalServer(ActionServer):
    """Starts a goal with a callback and ends it with `finish`, without a coroutine in between.

    rclpy 7.1 polls a coroutine that waits for a future in every iteration of its executor: one waiting goal would occupy a core.
    """

    def __init__(self, node: Node, action: Any, name: str, begin: Callable[[ServerGoalHandle], None],
                 accept: Callable[[Any], GoalResponse]) -> None:
        """
        Args:
            node: node that offers the action.
            action: type of the action.
            name: its name.
            begin: called with the handle of each accepted goal, which is executing by then.
            accept: returns whether a goal is accepted.
        """
        self._begin = begin
        profile = QoSProfile(depth=QUEUE_SIZE)
        super().__init__(node, action, name, self._never_executed, goal_callback=accept, cancel_callback=lambda _: CancelResponse.ACCEPT,
                         goal_service_qos_profile=profile, result_service_qos_profile=profile, cancel_service_qos_profile=profile)

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """Start the goal; rclpy calls this when it is accepted."""
        self._begin(goal_handle)

    def finish(self, goal_handle: ServerGoalHandle, result: Any) -> None:
        """Send the result of a goal whose final state is set."""
        super().notify_execute(goal_handle, lambda _: result)

    @staticmethod
    def _never_executed(_: ServerGoalHandle) -> None:
        raise AssertionError("goals of a GoalServer end with finish()")


class ServedGoal:
    """A goal as it is passed to the component; implements `perch_core.component.Goal`."""

    def __init__(self, server: GoalServer, handle: ServerGoalHandle, row: Any) -> None:
        self._server, self._handle, self._row = server, handle, row
        self.value = row.goal_value(handle.request)
        self.finished = False

    @property
    def cancel_requested(self) -> bool:
        """Whether the client has requested cancellation."""
        return bool(self._handle.is_cancel_requested)

    def feedback(self, value: Any) -> None:
        """Send feedback to the client."""
        self._handle.publish_feedback(self._row.feedback_message(value))

    def finish(self, ending: str, result: Any) -> None:
        """End the goal: "succeeded", "cancelled" (only where that was requested) or "aborted"."""
        self.finished = True
        if ending == "succeeded":
            self._handle.succeed()
        elif ending == "cancelled" and self._handle.is_cancel_requested:
            self._handle.canceled()
        else:
            self._handle.abort()
        self._server.finish(self._handle, self._row.result_message(result))

    def reject(self, reason: str) -> None:
        """Abort the goal with the reason for its rejection."""
        self.finish("aborted", self._row.rejected(reason))
