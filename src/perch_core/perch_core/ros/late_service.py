"""A service whose answers come later."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from rclpy.node import Node
from rclpy.qos import QoSProfile

WAITING = 1000
"""Requests, and answers that were not yet taken by who asked; ROS keeps ten, and drops the others without a word."""


class LateService:
    """Takes requests at once and sends each response when it is there.

    rclpy answers with what a callback returns: the node waits while the callback works. A coroutine would be polled on every turn
    of the executor (7.1), which keeps the core busy that the work needs. So the callback returns an empty response, and
    what was to be sent with it, the request's header, is kept for the real one.
    """

    def __init__(self, node: Node, srv_type: Any, name: str, take: Callable[[Any, Callable[[Any], None]], None]) -> None:
        """
        Args:
            node: offers the service.
            srv_type: of the service.
            name: of the service.
            take: called with a request and the function that sends its response, once.
        """
        self._take = take
        self._requests: dict[int, Any] = {}  # by the identity of the empty response that stands for the answer
        self._service = cast(Any, node.create_service(srv_type, name, self._receive, qos_profile=QoSProfile(depth=WAITING)))
        self._send = self._service.send_response
        self._service.send_response = self._keep_header

    def _receive(self, request: Any, response: Any) -> Any:
        self._requests[id(response)] = request
        return response

    def _keep_header(self, response: Any, header: Any) -> None:
        request = self._requests.pop(id(response))
        self._take(request, lambda answer: self._send(answer, header))
