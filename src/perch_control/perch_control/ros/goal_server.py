"""An action server whose goals end when the node says so."""

from __future__ import annotations

from typing import Any, Callable

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node


class GoalServer(ActionServer):
    """Starts a goal with a callback and ends it with `finish`, without a coroutine in between.

    rclpy 7.1 polls a coroutine that waits for a future on every turn of its executor: one waiting goal keeps one core busy.

    Args:
        node: the node.
        action: type of the action.
        name: its name.
        begin: called with the handle of each accepted goal, which is executing by then.
        accept: says whether a goal is accepted.
    """

    def __init__(self, node: Node, action: Any, name: str, begin: Callable[[ServerGoalHandle], None],
                 accept: Callable[[Any], GoalResponse]) -> None:
        self._begin = begin
        super().__init__(node, action, name, self._refuse_to_wait, goal_callback=accept,
                         cancel_callback=lambda _: CancelResponse.ACCEPT)

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """Start the goal; rclpy calls this when it is accepted."""
        self._begin(goal_handle)

    def finish(self, goal_handle: ServerGoalHandle, result: Any) -> None:
        """Send the result of a goal whose end state is set."""
        super().notify_execute(goal_handle, lambda _: result)

    @staticmethod
    def _refuse_to_wait(_: ServerGoalHandle) -> None:
        raise AssertionError("goals of a GoalServer end with finish()")
