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

DISCOVERY = 5.0  # a node that has just been started may not have found the service that it asks yet [s]
LOOK = 0.02      # between two looks for it [s]

Deliver = Callable[[Client[Any, Any], Any], None]


def connect_clients(node: Node, component: Component[Any], deliver: Deliver) -> None:
    """Make a component's clients; `deliver(port, answer)` takes each answer on the executor's thread."""
    for port in ports(type(component), Client):
        row = topics.service(port.channel(component))
        client = node.create_client(row.type, port.channel(component))
        setattr(component, port.name, _asker(node, port, row, client, deliver))


def _asker(node: Node, port: Client[Any, Any], row: topics.ServiceRow, client: Any, deliver: Deliver) -> Callable[[Any, int], None]:
    def send(request: Any) -> None:
        future = client.call_async(row.request_message(request))
        future.add_done_callback(lambda done: deliver(port, _answer(row, done)))

    def ask(request: Any, due: int) -> None:
        if client.service_is_ready():
            send(request)
            return
        end = time.monotonic() + DISCOVERY

        def look() -> None:
            ready = client.service_is_ready()
            if not ready and time.monotonic() < end:
                return
            node.destroy_timer(timer)
            if ready:
                send(request)
            else:
                deliver(port, Unavailable(f"service {client.srv_name} is not there"))

        timer = node.create_timer(LOOK, look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    return ask


def _answer(row: topics.ServiceRow, future: Any) -> Any:
    """The value of a finished call."""
    response = future.result()
    if response is None:
        return Unavailable(f"{row.channel} failed: {future.exception()}")
    try:
        return row.answer_value(response)
    except PerchError as error:
        return Unavailable(f"{row.channel} answered nonsense: {error}")
