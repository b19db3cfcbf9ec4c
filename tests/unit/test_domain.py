"""ROS domains: no two flights or tests on one machine share one."""

from __future__ import annotations

import socket

import pytest
from perch_core.errors import PerchError
from perch_eval.domain import USABLE, reserved_domain


@pytest.fixture
def nobody(monkeypatch):
    """Nobody takes part in any domain, whatever else runs on this machine."""
    monkeypatch.setattr("perch_eval.domain.participants", lambda domain: [])


@pytest.mark.usefixtures("nobody")
def test_reservations_differ_and_end(tmp_path):
    with reserved_domain([5, 6], tmp_path) as first:
        with reserved_domain([5, 6], tmp_path) as second:
            assert (first, second) == (5, 6)
            with pytest.raises(PerchError, match="every ROS domain is reserved"), reserved_domain([5, 6], tmp_path):
                pass
        with reserved_domain([5, 6], tmp_path) as again:
            assert again == 6
    with reserved_domain([5, 6], tmp_path) as free:
        assert free == 5


def test_a_domain_in_which_somebody_takes_part_is_not_given(tmp_path):
    with reserved_domain() as first, reserved_domain() as second:  # on this machine; in the other folder both are free
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.bind(("127.0.0.1", 7400 + 250 * first + 11))
            with reserved_domain([first, second], tmp_path) as domain:
                assert domain == second
        with reserved_domain([first, second], tmp_path) as domain:
            assert domain == first


def test_domains_keep_below_the_ephemeral_ports():
    # DDS: port = 7400 + 250 * domain + 2 * participant + offset; Linux hands out ports from 32768 on
    assert 7400 + 250 * max(USABLE) + 250 <= 32_900 and min(USABLE) > 0


@pytest.mark.usefixtures("nobody")
def test_a_process_does_not_use_a_domain_twice_in_a_row(tmp_path):
    with reserved_domain(folder=tmp_path) as taken:
        with reserved_domain(folder=tmp_path) as first:
            pass
        with reserved_domain(folder=tmp_path) as second:
            assert len({taken, first, second}) == 3


@pytest.mark.usefixtures("nobody")
def test_what_another_process_holds_does_not_bring_a_domain_back(tmp_path):
    with reserved_domain(folder=tmp_path) as first:
        pass
    after = USABLE[(USABLE.index(first) + 1) % len(USABLE)]
    with reserved_domain([after], tmp_path):
        with reserved_domain(folder=tmp_path) as second:
            pass
        with reserved_domain(folder=tmp_path) as third:
            assert len({first, after, second, third}) == 4
