"""A seed is a flight: composed, in separate processes and without ROS, whatever the environment says, whoever looks on or talks in."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from perch_eval import demo
from perch_eval.in_process import fly
from perch_eval.in_process.flights import Sensing
from perch_eval.nodes import ALL_NODES
from perch_sim.scenario import load_scenario
from system.scripts import PATIENCE, ROOT

SEED = 1
LINGER = 0.5  # as the pilot does: results of what was seen before the end come after it [s]
SHORT = """
extends: surface_90
name: short
nodes: [vehicle, vio_model, estimator, target_localizer, perching_planner, controller, mission]
parameters: {vehicle: {cameras: front}}
"""
THREADS = {"OMP_NUM_THREADS": "4", "OPENBLAS_NUM_THREADS": "4", "MKL_NUM_THREADS": "4"}
ECHOED = (("/odometry", "nav_msgs/msg/Odometry"), ("/imu/data_raw", "sensor_msgs/msg/Imu"), ("/motor_command", "perch_msgs/msg/MotorCommand"),
          ("/camera_front/image_raw", "sensor_msgs/msg/Image"), ("/trajectory", "perch_msgs/msg/Trajectory"))


@pytest.fixture(scope="module")
def scenario(tmp_path_factory) -> Path:
    """A perch whose VIO is a model, and whose front camera alone takes images."""
    file = tmp_path_factory.mktemp("scenario") / "short.yaml"
    file.write_text(SHORT)
    return file


@pytest.fixture(scope="module")
def flown(scenario) -> str:
    """The flight's hash without ROS."""
    trace = fly(load_scenario(scenario), SEED, Sensing(target="rendered"), linger=LINGER)
    assert trace.outcome == "perched", trace.message
    return trace.flight.digest(trace.end_time)


@pytest.fixture
def crowd(ros_domain, monkeypatch) -> Iterator[list[subprocess.Popen]]:
    """A foreign publisher on every topic, a viewer and five echoes, in the domain that the next demo flies in."""
    monkeypatch.setattr(demo, "reserved_domain", lambda: contextlib.nullcontext(ros_domain))
    for name, value in THREADS.items():
        monkeypatch.setenv(name, value)
    stranger = subprocess.Popen([sys.executable, str(Path(__file__).parent / "stranger.py")], stdout=subprocess.PIPE, text=True,
                                env={**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")))})
    scripts = [("run_node.py", "viewer", "--ros-args", "-p", "port:=0"), *(("topic.py", "echo", *topic) for topic in ECHOED)]
    others = [subprocess.Popen([sys.executable, str(ROOT / "scripts" / script), *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
              for script, *arguments in scripts]
    try:
        assert stranger.stdout.readline().startswith("up")
        yield [stranger, *others]
    finally:
        for process in (stranger, *others):
            process.terminate()
        for process in (stranger, *others):
            process.wait(PATIENCE)


@pytest.mark.parametrize("composed", [ALL_NODES, ()], ids=["composed", "separate"])
def test_a_crowd_has_no_influence(composed, scenario, flown, crowd, tmp_path):
    report = demo.fly(str(scenario), SEED, tmp_path, composed=composed)
    assert not {" ".join(process.args): process.poll() for process in crowd if process.poll() is not None}
    assert report["outcome"] == "perched", report["message"]
    assert report["flight_hash"] == flown
    log = (tmp_path / "logs" / ("composed.log" if composed else "vehicle.log")).read_text()
    for topic in ("trajectory", "controller/command", "motor_command", "odometry", "imu/data_raw"):
        assert log.count(f"[vehicle]: {topic}: /stranger publishes it but takes no part in the lockstep: it is ignored") == 1, topic


def test_threads_of_sums_have_no_influence(scenario, flown):
    """With both cameras, whose filter adds the most; in a process of its own, whose BLAS is told otherwise before it is loaded."""
    program = ("import sys, json; from perch_sim.scenario import load_scenario; from perch_eval.in_process import fly\n"
               "from perch_eval.in_process.flights import Sensing\n"
               "trace = fly(load_scenario(sys.argv[1]), 1, Sensing('rendered', 'rendered'))\n"
               "print(json.dumps(trace.flight.digest(trace.end_time)))")
    hashes = {json.loads(subprocess.run([sys.executable, "-c", program, str(scenario)], check=True, capture_output=True, text=True,
                                        env={**os.environ, **dict.fromkeys(THREADS, count)}).stdout) for count in ("1", "4")}
    assert len(hashes) == 1
