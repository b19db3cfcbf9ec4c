"""Service whose responses may be sent later."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from rclpy.node import Node
from rclpy.qos import QoSProfile

QUEUE_SIZE = 1000
"""Queue size of requests, and of responses that a client has not yet taken; by default, ROS silently drops all but ten."""


class LateService:
    """Takes requests at once and sends each response when it is available.

    rclpy sends what a callback returns, so that the node is blocked while the callback works. A coroutine would be polled in
    every iteration of the executor (7.1), which occupies the core that the work needs. Therefore the callback returns an empty
    response, which is not sent, and the request's header is kept for the actual one.
    """

    def __init__(self, node: Node, srv_type: Any, name: str, handle_request: Callable[[Any, Callable[[Any], None]], None]) -> None:
        """
        Args:
            node: node that offers the service.
            srv_type: type of the service.
            name: name of the service.
            handle_request: called with a request and the function that sends its response, once.
        """
        self._handle_request = handle_request
        self._requests: dict[int, Any] = {}  # by the identity of the empty response that stands for the answer
        self._service = cast(Any, node.create_service(srv_type, name, self._receive, qos_profile=QoSProfile(depth=QUEUE_SIZE)))
        self._send = self._service.send_response
        self._service.send_response = self._store_header

    def _receive(self, request: Any, response: Any) -> Any:
        self._requests[id(response)] = request
        return response

    def _store_header(self, response: Any, header: Any) -> None:
        request = self._requests.pop(id(response))
        self._handle_request(request, lambda answer: self._send(answer, header))
