"""Nodes work from plain publishers of standard messages: no process of the simulator, no Step, any rate, any clock."""

from __future__ import annotations

import re

import numpy as np
import pytest
from nodes.node_process import PLAIN, nodes, plain, set_parameter
from perch_core.vehicle import load_vehicle
from perch_eval.domain import reserved_domain


def test_the_plain_scripts_import_nothing_of_perch_but_messages():
    scripts = sorted(PLAIN.glob("*.py"))
    assert len(scripts) >= 4
    for script in scripts:
        imported = set(re.findall(r"^\s*(?:from|import) (perch\w*)", script.read_text(), re.M))
        assert imported <= {"perch_msgs"}, script


def check_chain(seen: dict) -> None:
    """Every sample was answered by the estimator and by the controller, from when the script was known to both and they to it."""
    sent, states, commands = ([stamp for stamp in seen[what] if stamp >= seen["begun"]] for what in ("sent", "states", "commands"))
    assert states == sent[:len(states)], "an answer is missing, or stamped with no sample's stamp"
    both = min(len(states), len(commands))  # the last answers of one stream may still be on their way where those of the other are here
    assert both and commands[:both] == states[:both] and commands == sent[:len(commands)]
    assert len(seen["speeds"]) == 4 and min(seen["speeds"]) > 100.0, "the controller has not armed"  # idle [rad/s]


@pytest.mark.parametrize("rate, count", [(100, 150), (200, 250), (1000, 1000)])
def test_every_imu_sample_is_answered_with_odometry_and_a_motor_command(rate, count, graph):
    seen = plain("states.py", str(rate), str(count))
    check_chain(seen)
    assert len(seen["commands"]) >= count
    assert seen["types"] and not [kind for kind in seen["types"] if "Step" in kind or "Packet" in kind]
    assert {"estimator", "controller"} <= set(seen["nodes"]) and not {"vehicle", "vio_model"} & set(seen["nodes"])


def test_time_may_be_that_of_a_clock_topic(graph):
    chosen = [graph[name] for name in ("estimator", "controller", "vio")]
    set_parameter(chosen, "use_sim_time", True)
    try:
        check_chain(plain("states.py", "200", "200", "clock"))
    finally:
        set_parameter(chosen, "use_sim_time", False)


@pytest.fixture(scope="module")
def unpacking(tmp_path_factory):
    """The nodes that see, for compressed images."""
    packed = {"images": "image_raw/compressed"}
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        with nodes(("estimator", "vio", "target_localizer"), tmp_path_factory.mktemp("unpacking"),
                   parameters={"vio": packed, "target_localizer": packed}) as running:
            yield running


@pytest.mark.parametrize("kind, chain", [("raw", "graph"), ("both", "graph"), ("compressed", "unpacking")])
def test_cameras_of_anybody_are_used(kind, chain, request, monkeypatch):
    """Images lead to odometry by the nodes `vio` and `estimator`, and with it to the pose of the board. `both`, as drivers with
    `image_transport` publish them: each image is used once."""
    running = request.getfixturevalue(chain)
    monkeypatch.setenv("ROS_DOMAIN_ID", running["vio"].domain)
    refused = running["vio"].log.count("not newer")
    seen = plain("cameras.py", kind)
    assert running["vio"].log.count("not newer") == refused
    poses, targets = np.array(seen["poses"]), np.array(seen["targets"])
    assert len(poses) >= 20 and len(targets) >= 5
    assert np.ptp(poses, axis=0).max() < 0.02, "a vehicle at rest moves"
    mount = load_vehicle("snapdragon").mounts["front"]
    assert np.median(targets - np.median(poses, axis=0), axis=0) == pytest.approx(mount.p_BC + [1.5, 0.0, 0.0], abs=0.03)


def test_wires_are_mapped(graph):
    lines = np.array(plain("wires.py", "--ros-args", "-r", "__ns:=/lines")["lines"])
    assert lines.shape == (1, 2, 3)
    assert lines[0, :, 0] == pytest.approx(4.0, abs=0.1) and lines[0, :, 2] == pytest.approx(1.5, abs=0.05)
    assert abs(lines[0, 0, 1] - lines[0, 1, 1]) > 2.0


def test_planners_plan(graph):
    plans = plain("plans.py")
    assert set(plans) == {"plan_perch", "plan_powerline"}
    for name, plan in plans.items():
        assert plan["success"], (name, plan["message"])
        assert plan["parts"] > 0 and plan["proofs"] and all(plan["proofs"])
