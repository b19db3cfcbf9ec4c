"""ROS domains: no two flights or tests on one machine share one."""

from __future__ import annotations

import mmap
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from perch_core.errors import PerchError
from perch_eval.domain import USABLE, reserved_domain


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
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 7400 + 250 * 5 + 11))
        with reserved_domain([5, 6], tmp_path) as domain:
            assert domain == 6
    with reserved_domain([5, 6], tmp_path) as domain:
        assert domain == 5


def test_nodes_start_in_a_domain_in_which_one_was_killed_as_it_made_its_port(tmp_path):
    """Fast DDS waits for ever for whoever made a segment to finish it."""
    with reserved_domain([100, 101], tmp_path) as domain:
        files = [Path(f"/dev/shm/fastrtps_port{7400 + 250 * domain + 11 + 2 * k}") for k in range(12)]
        used, *unused = files
        for file in files:
            file.write_bytes(bytes(4096))
    try:
        with used.open("r+b") as file, mmap.mmap(file.fileno(), 4096):
            with reserved_domain([domain], tmp_path):
                assert used.exists() and not any(file.exists() for file in unused)
        for file in files:
            file.write_bytes(bytes(4096))
        with reserved_domain([domain], tmp_path):
            subprocess.run([sys.executable, "-c", "import rclpy; rclpy.init(); rclpy.create_node('one'); rclpy.shutdown()"],
                           env={**os.environ, "ROS_DOMAIN_ID": str(domain)}, timeout=300, check=True)
    finally:
        for file in files:
            file.unlink(missing_ok=True)


def test_domains_keep_below_the_ephemeral_ports():
    # DDS: port = 7400 + 250 * domain + 2 * participant + offset; Linux hands out ports from 32768 on
    assert 7400 + 250 * max(USABLE) + 250 <= 32_900 and min(USABLE) > 0


def test_a_process_does_not_use_a_domain_twice_in_a_row(tmp_path):
    with reserved_domain(folder=tmp_path) as taken:
        with reserved_domain(folder=tmp_path) as first:
            pass
        with reserved_domain(folder=tmp_path) as second:
            assert len({taken, first, second}) == 3


def test_what_another_process_holds_does_not_bring_a_domain_back(tmp_path):
    with reserved_domain(folder=tmp_path) as first:
        pass
    after = USABLE[(USABLE.index(first) + 1) % len(USABLE)]
    with reserved_domain([after], tmp_path):
        with reserved_domain(folder=tmp_path) as second:
            pass
        with reserved_domain(folder=tmp_path) as third:
            assert len({first, after, second, third}) == 4
