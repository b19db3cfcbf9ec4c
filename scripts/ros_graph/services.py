"""Lists and calls services."""

from __future__ import annotations

import argparse
import sys

from ros_graph.commands import GraphError
from ros_graph.connection import hidden, visit
from ros_graph.interfaces import interface
from ros_graph.message_text import to_yaml
from ros_graph.message_values import fill, parse


def list_services(arguments: argparse.Namespace) -> int:
    """`service.py list`"""
    with visit() as graph:
        services = graph.settle(graph.node.get_service_names_and_types, arguments.spin_time)
    for name, types in sorted(services):
        if not hidden(name):
            print(f"{name} [{', '.join(types)}]" if arguments.show_types else name)
    return 0


def call_service(arguments: argparse.Namespace) -> int:
    """`service.py call`: prints the response; 1 where it says `success: false`."""
    cls = interface(arguments.type, "srv")
    request = fill(cls.Request(), parse(arguments.values, "request"))
    with visit() as graph:
        service = graph.absolute(arguments.service)
        client = graph.node.create_client(cls, service)
        if not graph.spin_until(client.service_is_ready, arguments.spin_time):
            raise GraphError(f"service {service} does not exist with type {arguments.type}; 'service.py list -t' shows all")
        response = graph.answer(client.call_async(request), service, timeout=30.0)
    sys.stdout.write(to_yaml(response))
    return 0 if getattr(response, "success", True) else 1
