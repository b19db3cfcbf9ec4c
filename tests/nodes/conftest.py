"""The nodes that a vehicle flies with, each alone in a process, without the simulator."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from nodes.node_process import FREE, Running, nodes
from perch_eval.domain import reserved_domain

@pytest.fixture(scope="session")
def free(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Running]]:
    """All of `FREE`; the mapper, which looks through another vehicle's camera, is in `/lines`. In the end they stop cleanly on SIGTERM."""
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        with nodes(FREE, tmp_path_factory.mktemp("free"), {"powerline_mapper": "/lines"}, {"perching_planner": {"time_limit": 45.0}}) as running:
            yield running


@pytest.fixture
def graph(free: dict[str, Running], monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Running]]:
    """The same, in the domain of this test's processes; afterwards all of them still work."""
    monkeypatch.setenv("ROS_DOMAIN_ID", free["estimator"].domain)
    yield free
    for node in free.values():
        node.check()
