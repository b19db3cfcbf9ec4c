"""Requests of a component to the services of other nodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from perch_core.component import Client, Component, Unavailable, ports
from perch_core.errors import PerchError
from perch_core.ros import topics
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

DISCOVERY = 5.0  # without a server for so long, a request is given up; a node that was just started finds it later [s]
LOOK = 0.1       # between two looks for servers while a request is open [s]
WATCH = 1.0      # between two looks at who would answer [s]

Deliver = Callable[[Client[Any, Any], Any], None]


def connect_clients(node: Node, component: Component[Any], deliver: Deliver) -> None:
    """Create the clients of a component; `deliver(port, answer)` takes each answer on the executor's thread."""
    for port in ports(type(component), Client):
        row = topics.service(port.channel(component))
        client = node.create_client(row.type, port.channel(component))
        setattr(component, port.name, _asker(node, port, row, client, deliver))
        _watch(node, component, client)


def _servers(node: Node, client: Any) -> set[bytes]:
    """Return the servers of a client: the publishers of its reply topic, under the middleware's name of the topic."""
    replies = f"rr{node.resolve_service_name(client.srv_name)}Reply"
    return {bytes(info.endpoint_gid) for info in node.get_publishers_info_by_topic(replies, no_mangle=True)}


def _watch(node: Node, component: Component[Any], client: Any) -> None:
    """Warn when another server appears, also while no request is open: a restarted server has lost its state."""
    known = set[bytes]()

    def look() -> None:
        servers = _servers(node, client)
        if known and not servers <= known:
            component.warn(f"{client.srv_name}: another node answers from now on: it was started anew, or is a second one")
        known.update(servers)

    node.create_timer(WATCH, look, clock=Clock(clock_type=ClockType.STEADY_TIME))


def _asker(node: Node, port: Client[Any, Any], row: topics.ServiceRow, client: Any, deliver: Deliver) -> Callable[[Any, int], None]:
    """Return a function that sends a request to every server that appears until one has answered: a server may be restarted."""
    def ask(request: Any, due: int) -> None:
        message, asked, calls = row.request_message(request), set[bytes](), list[Any]()
        unanswered, seen = True, time.monotonic()

        def finish(answer: Any) -> None:
            nonlocal unanswered
            if unanswered:
                unanswered = False
                node.destroy_timer(timer)
                for call in calls:
                    client.remove_pending_request(call)
                deliver(port, answer)

        def look() -> None:
            nonlocal seen
            if client.service_is_ready():
                seen = time.monotonic()
                servers = _servers(node, client)
                if not calls or not servers <= asked:
                    asked.update(servers)
                    calls.append(client.call_async(message))
                    calls[-1].add_done_callback(lambda done: finish(_answer(row, done)))
            elif time.monotonic() - seen > DISCOVERY:
                finish(Unavailable(f"service {client.srv_name} is not there"))

        timer = node.create_timer(LOOK, look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        look()

    return ask


def _answer(row: topics.ServiceRow, future: Any) -> Any:
    """Return the value of a finished call, or `Unavailable`."""
    response = future.result()
    if response is None:
        return Unavailable(f"{row.channel} failed: {future.exception()}")
    try:
        return row.answer_value(response)
    except PerchError as error:
        return Unavailable(f"{row.channel} answered nonsense: {error}")
