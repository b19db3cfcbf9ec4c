"""What all tests share: checked message fields, reproducible examples, ROS domains of their own."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

# Before the first message class is imported: by default a wrong type becomes silent garbage on the wire.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")

# No luck and no stop-watch: the same examples in each run, on slow machines too.
settings.register_profile(
    "perch", deadline=None, derandomize=True, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("perch")


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that nobody else on this machine uses; `ROS_DOMAIN_ID` is set to it."""
    from perch_eval.domain import reserved_domain

    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain
