"""What the ROS graph opens to the outside: nothing but loopback, unless the caller names a network."""

from __future__ import annotations

import ipaddress
import os
import socket
from pathlib import Path
from xml.etree import ElementTree

import pytest
from perch_core.errors import ConfigError
from perch_eval.arguments import open_network
from system import forks
from system.scripts import PATIENCE, ROOT

PEER = """
import os, sys, time
import rclpy
node = rclpy.create_node(f"peer_{os.getpid()}", context=(context := rclpy.Context(), context.init())[0])
end = time.monotonic() + 300.0  # only ever waited for in full when a test fails [s]
while len([name for name in node.get_node_names() if name.startswith("peer_")]) < int(sys.argv[1]):
    if time.monotonic() > end:
        sys.exit("the others are not there")
    time.sleep(0.01)
inodes = {os.readlink(f"/proc/self/fd/{fd}")[8:-1] for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")}
for protocol in ("udp", "udp6", "tcp", "tcp6"):
    for line in open(f"/proc/self/net/{protocol}").readlines()[1:]:
        address, inode = line.split()[1].split(":")[0], line.split()[9]
        if inode in inodes:
            print(bytes.fromhex(address)[::-1].hex() if len(address) == 8 else address, flush=True)
print("done", flush=True)
while not os.path.exists(sys.argv[2]):
    time.sleep(0.01)
node.destroy_node()
context.shutdown()
"""


def sockets(folder: Path, count: int, **variables: str) -> list[set[str]]:
    """The addresses to which the sockets of processes are bound that find each other as `count` ROS nodes."""
    script, over, peers, outputs, found = folder / "peer.py", folder / "over", [], [], []
    script.write_text(PEER)
    with (folder / "peers.log").open("w") as log:
        for _ in range(count):
            reads, writes = os.pipe()
            outputs.append(os.fdopen(reads))
            with os.fdopen(writes, "w") as output:
                peers.append(forks.Forked(forks.SCRIPTS, [str(script), str(count), str(over)], output, log, os.environ | variables))
    for output in outputs:
        with output:
            found.append({str(ipaddress.ip_address(bytes.fromhex(line.strip()))) for line in iter(output.readline, "done\n")})
    over.touch()
    assert [peer.wait(PATIENCE) for peer in peers] == [0] * count
    return found


def test_processes_find_each_other_over_sockets_that_are_bound_to_loopback(ros_domain, tmp_path):
    for addresses in sockets(tmp_path, 3):
        assert addresses == {"127.0.0.1"}


def test_what_they_miss_of_each_other_at_the_start_comes_with_an_announcement_half_a_second_later():
    """By default in 3 s: in every second start of a node on a busy machine."""
    period = next(element for element in ElementTree.parse(ROOT / "config" / "fastdds.xml").iter() if element.tag.endswith("}leaseAnnouncement"))
    seconds, nanoseconds = (int(element.text) for element in period)
    assert 0 < 10**9 * seconds + nanoseconds <= 500_000_000


def test_they_find_each_other_where_discovery_is_local_as_well(ros_domain, tmp_path):
    assert all(sockets(tmp_path, 2, ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST"))


def test_a_named_network_is_the_only_one_that_is_opened(ros_domain, monkeypatch, tmp_path):
    monkeypatch.setenv("PERCH_NETWORK", "127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
        try:
            route.connect(("192.0.2.1", 9))  # nothing is sent
        except OSError:
            pytest.skip("this machine is in no network")
        own = route.getsockname()[0]
    open_network(own)
    assert sockets(tmp_path, 2) == [{own}] * 2


@pytest.mark.parametrize("address", ["192.0.2.77", "0.0.0.0", "not-a-host.invalid", "1" * 300])
def test_an_address_that_is_not_ours_is_refused(monkeypatch, address):
    monkeypatch.setenv("PERCH_NETWORK", "127.0.0.1")
    with pytest.raises(ConfigError, match="^--network: .*(this machine)"):
        open_network(address)
    assert os.environ["PERCH_NETWORK"] == "127.0.0.1"
