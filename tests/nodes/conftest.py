"""What the tests of nodes share."""

from __future__ import annotations

import pytest
from nodes.vehicle_flight import Flight


@pytest.fixture
def flights(ros_domain):
    opened = []

    def start(**arguments) -> Flight:
        opened.append(Flight(ros_domain, **arguments))
        return opened[-1]

    yield start
    for flight in opened:
        flight.close()
