"""Requests of a component to the services of other nodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from perch_core.component import Client, Component, Unavailable, ports
from perch_core.ros import topics
from perch_core.ros.wiring import UNNAMED
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

DISCOVERY_TIMEOUT = 5.0  # a request fails after so long without a server; a node that has just started discovers it later [s]
ANSWER_TIMEOUT = 50.0    # a request fails so long after it was made: more than a plan may take, less than a simulated vehicle waits [s]
CHECK_PERIOD = 0.1       # of the check for servers while a request is open [s]
WATCH_PERIOD = 1.0       # of the check for new servers [s]

Send = Callable[[Any, Callable[[Any], None]], None]


def connect_clients(node: Node, component: Component[Any]) -> dict[Client[Any, Any], Send]:
    """Create the clients of a component.

    Returns:
        Port -> function (request, take) that sends a request; `take(answer)` is called on the executor's thread.
    """
    functions: dict[Client[Any, Any], Send] = {}
    for port in ports(type(component), Client):
        row = topics.service(port.channel(component))
        client = node.create_client(row.type, port.channel(component))
        functions[port] = _client_function(node, row, client)
        _watch_servers(node, component, client)
    return functions


def _server_infos(node: Node, service: str) -> list[Any]:
    """Return the servers of a service: the publishers of its reply topic, under the middleware's name of the topic."""
    return list(node.get_publishers_info_by_topic(f"rr{node.resolve_service_name(service)}Reply", no_mangle=True))


def _servers(node: Node, client: Any) -> set[bytes]:
    return {bytes(info.endpoint_gid) for info in _server_infos(node, client.srv_name)}


def server_names(node: Node, service: str) -> str:
    """Return the names of the nodes that offer a service, as far as discovered."""
    names = {info.node_name for info in _server_infos(node, service)} - {UNNAMED}
    return ", ".join(sorted(names)) or "a node that is not visible"


def _watch_servers(node: Node, component: Component[Any], client: Any) -> None:
    """Warn when another server appears, also while no request is open: a restarted server has lost its state."""
    known = set[bytes]()

    def check() -> None:
        servers = _servers(node, client)
        if known and not servers <= known:
            component.warn(f"{client.srv_name}: server restarted or second server detected")
        known.update(servers)

    node.create_timer(WATCH_PERIOD, check, clock=Clock(clock_type=ClockType.STEADY_TIME))


def _client_function(node: Node, row: topics.ServiceRow, client: Any) -> Send:
    """Return a function that sends a request to every server that appears until one has answered: a server may be restarted.

    Each request is answered, after `ANSWER_TIMEOUT` at the latest. One that is not the newest is sent to no further server, which
    would answer it before the newest; it ends with its server.
    """
    newest = 0

    def send_request(request: Any, take: Callable[[Any], None]) -> None:
        nonlocal newest
        newest = number = newest + 1
        requested, calls = set[bytes](), list[Any]()
        unanswered, problem, begun = True, "", time.monotonic()
        last_available = begun

        def finish(answer: Any) -> None:
            nonlocal unanswered
            if unanswered:
                unanswered = False
                node.destroy_timer(timer)
                for call in calls:
                    client.remove_pending_request(call)
                take(answer)

        def check() -> None:
            nonlocal last_available, problem
            now = time.monotonic()
            if now - begun > ANSWER_TIMEOUT:
                problem = f"{client.srv_name} has not answered within {ANSWER_TIMEOUT:g} s"
            if problem:
                node.get_logger().error(f"{problem}: the request is dropped")
                finish(Unavailable(problem))
            elif client.service_is_ready():
                last_available = now
                servers = _servers(node, client)
                if calls and number != newest:
                    if requested and not requested & servers:
                        finish(Unavailable(f"{client.srv_name}: the server has ended"))
                elif not calls or not servers <= requested:
                    requested.update(servers)
                    try:
                        calls.append(client.call_async(row.request_message(request)))
                    except Exception as error:  # of a value that has no message; answered by the timer, as who asks is at work
                        problem = f"{client.srv_name}: the request cannot be sent: {error}"
                    else:
                        calls[-1].add_done_callback(lambda done: finish(_answer(row, done)))
            elif now - last_available > DISCOVERY_TIMEOUT:
                finish(Unavailable(f"service {client.srv_name} is not available"))

        timer = node.create_timer(CHECK_PERIOD, check, clock=Clock(clock_type=ClockType.STEADY_TIME))
        check()

    return send_request


def _answer(row: topics.ServiceRow, future: Any) -> Any:
    """Return the value of a finished call, or `Unavailable`."""
    try:
        return row.answer_value(future.result())
    except Exception as error:  # the request must be answered
        return Unavailable(f"{row.channel} sent an invalid response: {error}")
