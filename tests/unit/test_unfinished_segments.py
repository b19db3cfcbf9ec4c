"""A process that is killed while it makes a port's shared memory holds up no other one."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from perch_core.ros import shared_memory
from perch_core.ros.shared_memory import remove_unfinished_segments
from perch_eval.domain import reserved_domain

PLAIN = "import rclpy; rclpy.init(); rclpy.create_node('one'); print('there'); rclpy.shutdown()"
OURS = "from perch_core.ros.shared_memory import remove_unfinished_segments; remove_unfinished_segments(); " + PLAIN


@pytest.fixture
def ports():
    """An environment, and the ports in which the first participants of its domain would receive."""
    with reserved_domain() as domain:
        files = [Path(f"/dev/shm/fastrtps_port{7400 + 250 * domain + 11 + 2 * k}") for k in range(12)]
        yield {**os.environ, "ROS_DOMAIN_ID": str(domain)}, files
        for file in files:
            file.unlink(missing_ok=True)


def test_only_ports_that_are_unfinished_are_ended(tmp_path):
    contents = {"fastrtps_port7411": bytes(64), "fastdds_port7413": b"", "fastrtps_port7415": b"\1" + bytes(63), "fastrtps_port7417": b"\2" + bytes(63),
                "fastrtps_port7411_el": b"", "fastrtps_0123456789abcdef": bytes(64), "sem.fastrtps_port7411_mutex": bytes(32), "other": b""}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    waiting = (tmp_path / "fastrtps_port7411").open("rb")
    assert {file.name for file in remove_unfinished_segments(tmp_path)} == {"fastrtps_port7411", "fastdds_port7413", "fastrtps_port7415"}
    assert {file.name for file in tmp_path.iterdir()} == set(list(contents)[3:])
    assert waiting.read(4) == b"\3\0\0\0"
    assert remove_unfinished_segments(tmp_path / "none") == remove_unfinished_segments(tmp_path) == []


def test_one_that_is_finished_in_time_stays(tmp_path, monkeypatch):
    file = tmp_path / "fastrtps_port7411"
    file.write_bytes(bytes(64))
    monkeypatch.setattr(shared_memory.time, "sleep", lambda duration: file.write_bytes(b"\2" + bytes(63)))
    assert remove_unfinished_segments(tmp_path) == [] and file.exists()


def test_one_of_before_the_clock_was_set_back_delays_no_start(tmp_path, monkeypatch):
    file, waits = tmp_path / "fastrtps_port7411", list[float]()
    file.write_bytes(bytes(64))
    os.utime(file, times=(time.time() + 3600.0,) * 2)
    monkeypatch.setattr(shared_memory.time, "sleep", waits.append)
    assert remove_unfinished_segments(tmp_path) == [file] and waits == [shared_memory.CREATION_TIMEOUT]


def test_our_nodes_start(ports):
    environment, files = ports
    for file in files:
        file.write_bytes(bytes(4096))
    done = subprocess.run([sys.executable, "-c", OURS], env=environment, timeout=300, check=True, capture_output=True)
    assert b"there" in done.stdout


def test_who_waits_goes_on_when_one_of_ours_starts(ports):
    environment, files = ports
    for file in files:
        file.write_bytes(bytes(4096))
    with subprocess.Popen([sys.executable, "-c", PLAIN], env=environment, stdout=subprocess.PIPE) as waiting:
        while not any(str(file) in Path(f"/proc/{waiting.pid}/maps").read_text() for file in files):  # it has one open
            assert waiting.poll() is None
            time.sleep(0.05)
        remove_unfinished_segments()
        assert waiting.communicate(timeout=300)[0] == b"there\n"
